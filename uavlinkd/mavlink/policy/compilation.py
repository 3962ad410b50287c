"""Who may say what: a policy for one peer or one local endpoint, each way.

*In* is what comes from the peer or endpoint, *out* what goes to it. The keys::

    role = "operator"                    a preset to start from, see `roles`; "all" lets everything through
    system_ids = [1, "10-20"]            MAVLink systems it may speak as; "all" trusts it with every one
    allow_in  = ["telemetry", "PING"]    what passes
    deny_in   = ["MAV_CMD_DO_FLIGHTTERMINATION"]            what does not, whatever allows it
    allow_out, deny_out                  the same for the other way
    rate_in   = { ATTITUDE = 10 }        frames a second of each message and component; also of a group's messages;
                                         swarm-member and observer have rates of their own, which these go before
    rate_out                             the same for the other way; also of each target and instance (battery 0, 1),
                                         to each program; telemetry's not of what is said once (STATUSTEXT)
    mavlink1 = true                      whether MAVLink 1 frames pass
    ground_station = true                whether its HEARTBEAT may claim to be a ground station's

A peer's policy fails closed: it needs `system_ids`, and a role or both `allow_in` and `allow_out` ([] lets nothing
pass). All keys are optional for a local endpoint, whose wire is trusted: without a role and a list everything passes.

Denial is best effort. An autopilot does most things in several ways (`alternatives` lists those that are known), and
its next release may add one. To keep an effect out, allow what is needed and nothing else.

A list's entries add up, a role's entries among them, and what is denied is denied whatever allows it. An entry is

``telemetry``            a group of `dialect.GROUPS` (small letters), or ``all``
``ATTITUDE``             a message by its name (capitals)
``files-read``           a group that allows only what reads of FILE_TRANSFER_PROTOCOL (READING_OPCODES)
``30``                   a message by its number: the way to name one that the dialect does not know
``MAV_CMD_NAV_TAKEOFF``  a command by its name; ``command:22`` by its number. Allowing one lets it through in
                         COMMAND_LONG and COMMAND_INT. Denying one keeps it out of all that carries commands, mission
                         items and cancellations among them, and with it what does the same: SET_MODE is
                         MAV_CMD_DO_SET_MODE, a mission item to fly to now is MAV_CMD_DO_REPOSITION, and
                         MAV_CMD_DO_AUX_FUNCTION can arm (`policy_settings.DONE_BY`).

A rate is kept for each component by itself: an autopilot and its gimbal both send HEARTBEAT, and were the rate theirs
together, whoever comes first in each second would silence the other for minutes. But what comes in may name any
component, so all components of a system together have SYSTEM_SHARE times the rate: invented ones gain no more. What
goes out has passed another's gate already, so there each flow has the rate, as where a link thins (`egress_kinds`),
to each of the programs at an endpoint. And from groups of what is reported again and again, as `telemetry`, what is
said once or in parts is not thinned out: a line of a text that is missing never comes again. Named by itself it is.

What a policy cannot see into passes or not as a whole: files, shells, tunnels, raw buses. A policy that denies a
command and lets one of those through gets a warning, as the command may travel inside. A message that the dialect
does not know, or in another definition than the dialect's, passes only where ``all`` or its number is allowed.

SETUP_SIGNING carries a signing key in clear. It never passes, whatever a policy says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.alternatives import full_command_name, open_effects
from uavlinkd.mavlink.dialect_table import MESSAGES
from uavlinkd.mavlink.policy.gate import SAME_AS_COMMAND, Condition, Gate, Refusal
from uavlinkd.mavlink.policy.settings import PolicyError, PolicyProblem, Rules, Settings, read_settings

__all__ = ["Policy", "PolicyError", "PolicyProblem", "PolicyRow", "compile_policy"]

# What can carry a command where no policy sees it.
OPAQUE: Final = (*dialect.GROUPS["shell"], "FILE_TRANSFER_PROTOCOL")


class PolicyRow(NamedTuple):
    """One line of a policy's table for people."""

    subject: str
    incoming: str
    outgoing: str


class Policy:
    """What one peer or endpoint may say (`incoming`) and be told (`outgoing`)."""

    __slots__ = ("_settings", "incoming", "outgoing", "warnings")

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.incoming = Gate(
            settings.rules_in,
            settings.rates_in,
            is_incoming=True,
            systems=settings.systems,
            mavlink1=settings.mavlink1,
            ground_station=settings.ground_station,
        )
        self.outgoing = Gate(
            settings.rules_out,
            settings.rates_out,
            is_incoming=False,
            systems=None,
            mavlink1=settings.mavlink1,
            ground_station=True,
        )
        # Sentences for the operator, the gravest first.
        self.warnings = tuple(_warnings(settings, self.incoming, self.outgoing))

    def describe(self) -> list[PolicyRow]:
        """The policy as a table: each group of messages, and what holds beside them."""
        settings = self._settings
        rules = (settings.rules_in, settings.rules_out)
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
        rows.append(PolicyRow("rates", _rates_text(settings.rates_in), _rates_text(settings.rates_out)))
        return rows


def compile_policy(data: Mapping[str, object], *, is_local: bool = False) -> Policy:
    """The policy that plain data (see this module's head) describes.

    `is_local`: of a local endpoint, where every key is optional and no data lets everything pass. A peer's policy
    must say what passes each way and which systems the peer may speak as.

    Raises:
        PolicyError: with every problem in the data, each with its key and its remedy.
    """
    return Policy(read_settings(data, is_local=is_local))


def _warnings(settings: Settings, incoming: Gate, outgoing: Gate) -> list[str]:
    if settings.is_empty:
        return ["no policy: it may speak as any system and send anything but SETUP_SIGNING"]
    found = []
    if settings.role == dialect.ALL:
        found.append('role = "all": it may send every message and command that no list denies')
    if settings.systems is None:
        found.append('system_ids is "all": it may speak as any system, the ground station\'s among them')
    for way, rules, gate in (("in", settings.rules_in, incoming), ("out", settings.rules_out, outgoing)):
        if rules.denies_all:
            continue
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
            asked = ", ".join(by_message.get(command, command) for command in denied)
            found.append(
                f"deny_{way} keeps out {asked}, but {name} stays possible by {', '.join(still_open)}:"
                f" denial is best effort; to keep the effect out, write no role and allow_{way} = what is needed"
            )
        if not rules.denied_commands:
            continue
        ids = dialect.ids_by_name()
        through = [
            name
            for name in OPAQUE
            if ids[name] not in rules.denied
            and (rules.allows_all or ids[name] in rules.allowed or ids[name] in rules.allowed_numbers)
        ]
        if through:
            found.append(f"deny_{way} names commands that may still travel unseen inside {', '.join(through)}")
    return found


def _group_text(gate: Gate, members: tuple[str, ...]) -> str:
    """Which of a group's messages pass."""
    ids = dialect.ids_by_name()
    verdicts = {name: gate.decide(ids[name], is_known=True) for name in members}
    passing = [name for name, verdict in verdicts.items() if not isinstance(verdict, Refusal)]
    conditions = {name: verdict for name in passing if isinstance(verdict := verdicts[name], Condition)}
    limited = [name for name, each in conditions.items() if each.only_commands is not None or each.never_commands]
    reading = [name for name, each in conditions.items() if each.only_reads_files]
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
