"""Policies: the messages that one peer or one local endpoint may send and receive.

*In* is the direction from the peer or endpoint, *out* the direction to it. ``config/README.md`` has the keys and the
entries of lists. A peer's policy fails closed: it needs `system_ids`, and a role or both `allow_in` and `allow_out`.
All keys are optional for a local endpoint, whose wire is trusted. The entries of a list add to those of the role.

An allowed command passes in COMMAND_LONG and COMMAND_INT. What a receiver executes at once belongs to its command: a
mission item with a `current` of 2 or 3 passes only where that command does (`gate.DONE_AT_ONCE`), and the groups for
transfers contain no message that acts at once.

Each component has a rate of its own: with a common rate, an autopilot and its gimbal would silence each other. An
incoming frame may name any component, so all components of a system together have SYSTEM_SHARE times the rate.
Outgoing frames have passed another gate already, so there each flow to each client has the rate. The rate of a group
of repeated reports does not apply to its messages that are sent once: a missing line of text is never repeated.

A policy cannot inspect the content of files, shells, tunnels and raw buses. A message that the dialect does not know,
or has in another definition, passes only if ``all`` or its number is allowed. No policy passes SETUP_SIGNING, which
carries a signing key in clear, nor a request for a file with one (`secrets`).

A message that is longer than its definition passes by the fields that the dialect has (`frames`). A policy cannot
inspect the extension fields of a newer definition. They are optional: a known field means the same without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.settings import Rules, Settings, read_settings


class PolicyRow(NamedTuple):
    """One line of a policy's table for people."""

    subject: str
    incoming: str
    outgoing: str


class Policy:
    """What one peer or endpoint may send (`incoming`) and receive (`outgoing`), by the keys of the configuration.

    `is_local`: for a local endpoint, where every key is optional and everything passes without data.
    Raises PolicyError with every problem in the data, each with its key and its remedy.
    """

    __slots__ = ("_settings", "incoming", "outgoing", "warnings")

    def __init__(self, data: Mapping[str, object], *, is_local: bool = False) -> None:
        settings = self._settings = read_settings(data, is_local=is_local)
        self.incoming, self.outgoing = Gate(settings, "in"), Gate(settings, "out")
        self.incoming.opposite, self.outgoing.opposite = self.outgoing, self.incoming
        # Sentences for the operator, the most severe first.
        self.warnings = tuple(_warnings(settings))

    @property
    def is_of_person(self) -> bool:
        """Whether a person is at the other end: an operator, or an observer."""
        return self._settings.role in ("operator", "observer")

    def __str__(self) -> str:
        """The role and the systems, for a line of text."""
        settings = self._settings
        systems = settings.systems_text if settings.systems is None else f"system {settings.systems_text}"
        return f"{settings.role or 'by its lists'}, {systems}"

    def describe(self) -> list[PolicyRow]:
        """The policy as a table: each group of messages, and the other rules.

        A message passes in a direction if a row allows its group or its name, and no row refuses a whole group that
        contains it. The group `urgent` sets only the order: each of its messages is in another group.
        """
        settings = self._settings
        gates, rules = (self.incoming, self.outgoing), settings.rules.values()
        mavlink1 = _passes(settings.mavlink1)
        unknown = (_passes(side.allows_all) for side in rules)
        groups = [(name, members) for name, members in dialect.GROUPS.items() if name != "urgent"]
        return [
            *(PolicyRow(name, *(_group_text(gate, members) for gate in gates)) for name, members in groups),
            PolicyRow("commands by number", *map(_commands_text, rules)),
            PolicyRow("messages by number", *map(_numbers_text, rules)),
            PolicyRow("messages unknown to the dialect", *unknown),
            PolicyRow("MAVLink 1", mavlink1, mavlink1),
            PolicyRow("ground station's HEARTBEAT", _passes(settings.ground_station), "passes"),
            PolicyRow("rates", *map(_rates_text, settings.rates.values())),
        ]


def _warnings(settings: Settings) -> list[str]:
    if settings.is_empty:
        return ["no policy: it may send as any system, and any message but SETUP_SIGNING"]
    warnings = []
    if settings.role == dialect.ALL:
        warnings.append('role = "all": it may send every message and command')
    if settings.systems is None:
        warnings.append('system_ids is "all": it may send as any system, including the ground station')
    return warnings


def _group_text(gate: Gate, members: tuple[str, ...]) -> str:
    """The messages of a group that pass, as text."""
    verdicts = {name: gate.decide(dialect.IDS[name], is_known=True) for name in members}
    passing = {name: verdict for name, verdict in verdicts.items() if not isinstance(verdict, Refusal)}
    if not passing:
        return "none" if members != ("SETUP_SIGNING",) else "never"
    if len(passing) == len(members):
        text = "all"
    elif len(passing) * 2 > len(members):
        text = f"all but {', '.join(name for name in members if name not in passing)}"
    else:
        text = f"only {', '.join(passing)}"
    conditions = {name: verdict for name, verdict in passing.items() if verdict is not None}
    limited = [name for name, one in conditions.items() if one.only_commands is not None or one.never_current]
    partly = [name for name, one in conditions.items() if one.only_opcodes is not None]
    text += f" (by command: {', '.join(limited)})" if limited else ""
    return text + (f" (not all requests: {', '.join(partly)})" if partly else "")


def _passes(is_allowed: bool) -> str:
    return "passes" if is_allowed else "refused"


def _commands_text(rules: Rules) -> str:
    return ", ".join(map(dialect.command_name, sorted(rules.allowed_commands))) or "-"


def _numbers_text(rules: Rules) -> str:
    return ", ".join(map(str, sorted(rules.allowed_numbers))) or "-"


def _rates_text(rates: Mapping[int, float]) -> str:
    by_rate: dict[float, list[str]] = {}
    for msgid, rate in sorted(rates.items()):
        by_rate.setdefault(rate, []).append(dialect.name_of(msgid))
    return "; ".join(f"{', '.join(names)} {rate:g}/s" for rate, names in by_rate.items()) or "-"
