"""Policies: the messages that one peer or one local endpoint may send and receive.

*In* is the direction from the peer or endpoint, *out* the direction to it. The keys::

    role = "operator"                    a preset, see `roles`; "all" passes everything
    system_ids = [1, "10-20"]            MAVLink systems that it may send as; "all" trusts it with every system
    allow_in  = ["telemetry", "PING"]    what passes
    deny_in   = ["MAV_CMD_DO_FLIGHTTERMINATION"]            what does not pass, even if allowed
    allow_out, deny_out                  the same for the other direction
    rate_in   = { ATTITUDE = 10 }        frames a second of each message and component; also of a group's messages;
                                         replaces a rate of the role (swarm-member and observer have rates)
    rate_out                             the same for the other direction, for each target, instance (battery 0, 1)
                                         and client; telemetry's does not apply to messages sent once (STATUSTEXT)
    mavlink1 = true                      whether MAVLink 1 frames pass
    ground_station = true                whether its HEARTBEAT may claim to be a ground station's

A peer's policy fails closed: it needs `system_ids`, and a role or both `allow_in` and `allow_out` ([] passes
nothing). All keys are optional for a local endpoint, whose wire is trusted. The reasons are in
`uavlinkd/config/README.md`.

The entries of a list add to those of the role. A denied entry is denied even if another entry allows it. An entry is

``telemetry``            a group of `dialect.GROUPS` (small letters), or ``all``
``ATTITUDE``             a message by its name (capitals)
``files-read``           a group that allows only the reading requests of FILE_TRANSFER_PROTOCOL (READING_OPCODES)
``30``                   a message by its number, for messages that the dialect does not know
``MAV_CMD_NAV_TAKEOFF``  a command by its name; ``command:22`` by its number. An allowed command passes in
                         COMMAND_LONG and COMMAND_INT; MAV_CMD_REQUEST_MESSAGE only for a message that may pass in the
                         other direction. A denied command is refused in all messages that carry commands, and with it
                         messages and commands with the same effect (`gate.SAME_AS_COMMAND`, `settings.DONE_BY`).

Each component has a rate of its own: with a common rate, an autopilot and its gimbal would silence each other. An
incoming frame may name any component, so all components of a system together have SYSTEM_SHARE times the rate.
Outgoing frames have passed another gate already, so there each flow to each client has the rate. The rate of a group
of repeated reports does not apply to its messages that are sent once: a missing line of text is never repeated.

A policy cannot inspect the content of files, shells, tunnels and raw buses. A message that the dialect does not know,
or has in another definition, passes only if ``all`` or its number is allowed. No policy passes SETUP_SIGNING, which
carries a signing key in clear.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.policy.alternatives import full_command_name, open_effects
from uavlinkd.mavlink.policy.gate import REQUEST_MESSAGE, SAME_AS_COMMAND, Condition, Gate, Refusal
from uavlinkd.mavlink.policy.settings import Direction, Rules, Settings, read_settings

# Messages that can contain a command which a policy cannot inspect.
OPAQUE: Final = (*dialect.GROUPS["shell"], "FILE_TRANSFER_PROTOCOL")


class PolicyRow(NamedTuple):
    """One line of a policy's table for people."""

    subject: str
    incoming: str
    outgoing: str


class Policy:
    """What one peer or endpoint may send (`incoming`) and receive (`outgoing`)."""

    __slots__ = ("_settings", "incoming", "outgoing", "warnings")

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.incoming, self.outgoing = Gate(settings, "in"), Gate(settings, "out")
        self.incoming.opposite, self.outgoing.opposite = self.outgoing, self.incoming
        # Sentences for the operator, the most severe first.
        self.warnings = tuple(_warnings(settings, {"in": self.incoming, "out": self.outgoing}))

    def describe(self) -> list[PolicyRow]:
        """The policy as a table: each group of messages, and the other rules."""
        settings = self._settings
        rules = settings.rules.values()
        gates = (self.incoming, self.outgoing)
        rows = [
            PolicyRow("role", settings.role or "none", settings.role or "none"),
            PolicyRow("may speak as", settings.systems_text, "-"),
        ]
        rows += [
            PolicyRow(name, *(_group_text(gate, members) for gate in gates))
            for name, members in dialect.GROUPS.items()
        ]
        rows.append(PolicyRow("commands by number", *(_commands_text(side) for side in rules)))
        rows.append(PolicyRow("messages by number", *(_numbers_text(side) for side in rules)))
        unknown = ("passes" if side.allows_all and not side.denies_all else "refused" for side in rules)
        rows.append(PolicyRow("messages unknown to the dialect", *unknown))
        version1 = "passes" if settings.mavlink1 else "refused"
        rows.append(PolicyRow("MAVLink 1", version1, version1))
        rows.append(
            PolicyRow("ground station's HEARTBEAT", "passes" if settings.ground_station else "refused", "passes")
        )
        rows.append(PolicyRow("rates", *map(_rates_text, settings.rates.values())))
        return rows


def compile_policy(data: Mapping[str, object], *, is_local: bool = False) -> Policy:
    """The policy that plain data describes, see this module's docstring.

    `is_local`: for a local endpoint, where every key is optional and everything passes without data. A peer's policy
    must define what passes in each direction, and the systems that the peer may send as.

    Raises:
        PolicyError: with every problem in the data, each with its key and its remedy.
    """
    return Policy(read_settings(data, is_local=is_local))


def _warnings(settings: Settings, gates: Mapping[Direction, Gate]) -> list[str]:
    if settings.is_empty:
        return ["no policy: it may send as any system, and any message but SETUP_SIGNING"]
    warnings = []
    if settings.role == dialect.ALL:
        warnings.append('role = "all": it may send every message and command that no list denies')
    if settings.systems is None:
        warnings.append('system_ids is "all": it may send as any system, including the ground station')
    for direction, gate in gates.items():
        rules = settings.rules[direction]
        if rules.denies_all:
            continue
        if REQUEST_MESSAGE in rules.allowed_commands and gate.opposite.passes_nothing:
            warnings.append(
                f"allow_{direction} has MAV_CMD_REQUEST_MESSAGE, but the other direction passes no message: every"
                " request is refused; allow the answers there"
            )
        # A denied message with the effect of a command counts as that command.
        same = {
            SAME_AS_COMMAND[msgid]: dialect.name_of(msgid)
            for msgid in sorted(rules.denied)
            if msgid in SAME_AS_COMMAND
        }
        by_message = {
            full_command_name(number): name for number, name in same.items() if number not in rules.denied_commands
        }
        for name, denied, still_open in open_effects(rules.denied_commands | set(same), gate.lets_act):
            asked = ", ".join(by_message.get(command, command) for command in denied)  # as the file names them
            warnings.append(
                f"deny_{direction} refuses {asked}, but {name} stays possible by {', '.join(still_open)}:"
                f" denial is best effort; to block the effect, write no role, and in allow_{direction} only what is"
                " needed"
            )
        if not rules.denied_commands:
            continue
        ids = dialect.IDS
        through = [
            name
            for name in OPAQUE
            if ids[name] not in rules.denied
            and (rules.allows_all or ids[name] in rules.allowed or ids[name] in rules.allowed_numbers)
        ]
        if through:
            warnings.append(
                f"deny_{direction} names commands that may still pass inside {', '.join(through)}: a policy cannot"
                " inspect these messages"
            )
    return warnings


def _group_text(gate: Gate, members: tuple[str, ...]) -> str:
    """The messages of a group that pass, as text."""
    ids = dialect.IDS
    verdicts = {name: gate.decide(ids[name], is_known=True) for name in members}
    passing = [name for name, verdict in verdicts.items() if not isinstance(verdict, Refusal)]
    conditions = {name: verdict for name in passing if isinstance(verdict := verdicts[name], Condition)}
    limited = [
        name
        for name, condition in conditions.items()
        if condition.only_commands is not None or condition.never_commands
    ]
    reading = [name for name, condition in conditions.items() if condition.only_reads_files]
    if not passing:
        return "none" if members != ("SETUP_SIGNING",) else "never"
    if len(passing) == len(members):
        text = "all"
    elif len(passing) * 2 > len(members):
        text = f"all but {', '.join(name for name in members if name not in passing)}"
    else:
        text = f"only {', '.join(passing)}"
    text += f" (by command: {', '.join(limited)})" if limited else ""
    return text + (f" (only reading: {', '.join(reading)})" if reading else "")


def _commands_text(rules: Rules) -> str:
    allowed = ", ".join(dialect.command_name(number) for number in sorted(rules.allowed_commands))
    denied = ", ".join(dialect.command_name(number) for number in sorted(rules.denied_commands))
    parts = ([f"allowed: {allowed}"] if allowed else []) + ([f"denied: {denied}"] if denied else [])
    return "; ".join(parts) or "-"


def _numbers_text(rules: Rules) -> str:
    denied = sorted(number for number in rules.denied if number not in MESSAGES)
    parts = [f"allowed: {', '.join(map(str, sorted(rules.allowed_numbers)))}"] if rules.allowed_numbers else []
    parts += [f"denied: {', '.join(map(str, denied))}"] if denied else []
    return "; ".join(parts) or "-"


def _rates_text(rates: Mapping[int, float]) -> str:
    return ", ".join(f"{dialect.name_of(msgid)} {rate:g}/s" for msgid, rate in sorted(rates.items())) or "-"
