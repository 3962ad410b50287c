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

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.alternatives import full_command_name, open_effects
from uavlinkd.mavlink.dialect_table import COMMANDS, MESSAGES
from uavlinkd.mavlink.egress_kinds import FlowKey, flow_key, kind_of
from uavlinkd.mavlink.frames import Frame, Header
from uavlinkd.mavlink.policy_settings import (
    FILE_TRANSFER,
    READING_OPCODES,
    PolicyError,
    PolicyProblem,
    Rules,
    Settings,
    read_settings,
)

__all__ = [
    "ANY_OTHER",
    "Gate",
    "Policy",
    "PolicyError",
    "PolicyProblem",
    "PolicyRow",
    "Refusal",
    "compile_policy",
]

ANY_OTHER: Final = -1  # stands for every message beyond those that are counted by themselves
MAX_COUNTED: Final = 1024  # message ids and reasons counted by themselves, of one policy and way
MAX_BUCKETS: Final = 4096  # flows, and messages of systems, with a rate limit, likewise
MAX_DECISIONS: Final = 1024  # message ids whose decision is remembered, likewise
BURST_S: Final = 0.5  # how much of a second's frames may come at once
SYSTEM_SHARE: Final = 16  # what all components of a system may send of a message, in rates of one

HEARTBEAT: Final = 0
TYPE_IN_HEARTBEAT: Final = 4  # offset in its payload
MAV_TYPE_GCS: Final = 6

COMMAND_CARRIERS: Final = frozenset(msgid for msgid, row in MESSAGES.items() if row[6] is not None)
DIRECT_COMMANDS: Final = frozenset(dialect.ids_by_name()[name] for name in ("COMMAND_LONG", "COMMAND_INT"))

# Messages that do what a command does.
SAME_AS_COMMAND: Final[Mapping[int, int]] = {
    dialect.ids_by_name()[message]: number
    for message, command in (
        ("SET_MODE", "DO_SET_MODE"),
        ("MISSION_SET_CURRENT", "DO_SET_MISSION_CURRENT"),
        ("SET_HOME_POSITION", "DO_SET_HOME"),
        ("REQUEST_DATA_STREAM", "SET_MESSAGE_INTERVAL"),
        ("MOUNT_CONFIGURE", "DO_MOUNT_CONFIGURE"),
        ("MOUNT_CONTROL", "DO_MOUNT_CONTROL"),
        ("DIGICAM_CONFIGURE", "DO_DIGICAM_CONFIGURE"),
        ("DIGICAM_CONTROL", "DO_DIGICAM_CONTROL"),
        ("GIMBAL_MANAGER_SET_PITCHYAW", "DO_GIMBAL_MANAGER_PITCHYAW"),
        ("GIMBAL_MANAGER_SET_ATTITUDE", "DO_GIMBAL_MANAGER_PITCHYAW"),
        ("GIMBAL_MANAGER_SET_MANUAL_CONTROL", "DO_GIMBAL_MANAGER_PITCHYAW"),
        ("STORM32_GIMBAL_MANAGER_CONTROL_PITCHYAW", "STORM32_DO_GIMBAL_MANAGER_CONTROL_PITCHYAW"),
        ("AUTOPILOT_VERSION_REQUEST", "REQUEST_AUTOPILOT_CAPABILITIES"),
        ("SET_GPS_GLOBAL_ORIGIN", "DO_SET_GLOBAL_ORIGIN"),
        ("PARAM_SET", "DO_SET_PARAMETER"),
        ("SET_MAG_OFFSETS", "PREFLIGHT_SET_SENSOR_OFFSETS"),
        ("UAVIONIX_ADSB_OUT_CONTROL", "DO_ADSB_OUT_IDENT"),
    )
    if (number := dialect.command_number(command)) is not None
}

# ArduPilot does at once, whatever its command, what such a mission item says: by the value of `current`.
MISSION_ITEMS: Final = frozenset(dialect.ids_by_name()[name] for name in ("MISSION_ITEM", "MISSION_ITEM_INT"))
CURRENT_IN_MISSION_ITEM: Final = 35  # offset in the payload of both
DONE_AT_ONCE: Final[Mapping[int, int]] = {
    2: COMMANDS["MAV_CMD_DO_REPOSITION"],
    3: COMMANDS["MAV_CMD_DO_CHANGE_ALTITUDE"],
}

# Behind three bytes of target: sequence 2, session 1, opcode 1.
OPCODE_IN_FILE_TRANSFER: Final = 6

# Carries five command numbers at once, which are not looked at: refused where any command is denied.
CARRIES_MANY_COMMANDS: Final = frozenset({dialect.ids_by_name()["TRAJECTORY_REPRESENTATION_WAYPOINTS"]})

# What can carry a command where no policy sees it.
OPAQUE: Final = (*dialect.GROUPS["shell"], "FILE_TRANSFER_PROTOCOL")


class Refusal(StrEnum):
    """Why a frame may not pass."""

    FOREIGN_SYSTEM = "foreign_system"  # speaks as a system that it is not
    MESSAGE_NOT_ALLOWED = "message_not_allowed"
    UNKNOWN_MESSAGE = "unknown_message"  # not in the dialect, or not as the dialect defines it
    COMMAND_NOT_ALLOWED = "command_not_allowed"
    FILE_WRITE_NOT_ALLOWED = "file_write_not_allowed"  # FILE_TRANSFER_PROTOCOL, and not what reads
    SETUP_SIGNING = "setup_signing"
    MAVLINK1_NOT_ALLOWED = "mavlink1_not_allowed"
    GROUND_STATION_NOT_ALLOWED = "ground_station_not_allowed"
    RATE_LIMITED = "rate_limited"
    HIDDEN_FRAME = "hidden_frame"  # its bytes hold, or complete, another frame that may not pass: see `delivery`


class PolicyRow(NamedTuple):
    """One line of a policy's table for people."""

    subject: str
    incoming: str
    outgoing: str


_Buckets = dict[FlowKey, tuple[float, float]]
"""Tokens, and when that was, by what shares them."""


@dataclass(frozen=True, slots=True)
class _Condition:
    """What a frame of one message must still meet."""

    only_commands: frozenset[int] | None = None  # None: any
    never_commands: frozenset[int] = frozenset()
    never_current: frozenset[int] = frozenset()  # values of a mission item's field
    only_reads_files: bool = False
    refuses_ground_station: bool = False
    per_second: float | None = None

    def takes_command(self, number: int | None) -> bool:
        """Whether a frame with this command meets it."""
        return (self.only_commands is None or number in self.only_commands) and number not in self.never_commands


class Gate:
    """One way of one policy."""

    __slots__ = (
        "_buckets",
        "_decisions",
        "_ground_station",
        "_is_incoming",
        "_mavlink1",
        "_of_systems",
        "_passes_unknown",
        "_rates",
        "_rules",
        "_systems",
        "refused",
    )

    def __init__(
        self,
        rules: Rules,
        rates: Mapping[int, float],
        *,
        is_incoming: bool,
        systems: frozenset[int] | None,
        mavlink1: bool,
        ground_station: bool,
    ) -> None:
        self._rules = rules
        self._rates = rates
        self._is_incoming = is_incoming
        self._systems = systems
        self._mavlink1 = mavlink1
        self._ground_station = ground_station
        rules_pass_unknown = (rules.allows_all or bool(rules.allowed_numbers)) and not rules.denies_all
        passes_everything = (
            rules.allows_all and not rules.denied and not rules.denied_commands and mavlink1 and ground_station
        )
        self._passes_unknown = rules_pass_unknown and not (passes_everything and systems is None)
        self._decisions: dict[int, Refusal | _Condition | None] = {}
        self._buckets: _Buckets = {}
        self._of_systems: _Buckets = {}
        self.refused: Counter[tuple[int, Refusal]] = Counter()  # by message id (or ANY_OTHER) and reason

    def check(self, frame: Frame, now: float, to: int = 0) -> Refusal | None:
        """None if the frame may pass, else why not, which is counted. `now` in seconds, monotonic.

        `to`: which of several programs it goes out to. Each has the rate: a frame is another one for each of them.
        """
        verdict = self._verdict(frame.header)
        refusal = self._unmet(verdict, frame, now, to) if isinstance(verdict, _Condition) else verdict
        if refusal is not None:
            self.count(frame.header, refusal)
        return refusal

    def count(self, header: Header, refusal: Refusal) -> None:
        """Count a frame that did not pass."""
        counted = (header.msgid, refusal)
        if len(self.refused) >= MAX_COUNTED and counted not in self.refused:
            counted = (ANY_OTHER, refusal)
        self.refused[counted] += 1

    def permits(self, frame: Frame) -> bool:
        """Whether the frame may pass, at any rate. Counts nothing and uses up no rate."""
        verdict = self._verdict(frame.header)
        if isinstance(verdict, _Condition):
            return self._breach(verdict, frame) is None
        return verdict is None

    @property
    def passes_unknown(self) -> bool:
        """Whether a message that the dialect does not know may pass: of some systems, but not of every one.

        Then a frame is valid by any CRC_EXTRA. Where all that there is may pass, nothing needs to be told apart.
        """
        return self._passes_unknown

    def may_speak_as(self, system: int) -> bool:
        """Whether frames of this system are let pass at all."""
        return self._systems is None or system in self._systems

    def always_passes(self, header: Header) -> bool:
        """Whether every frame with this header passes, at any rate: `check` need not be asked."""
        return self._verdict(header) is None

    def _verdict(self, header: Header) -> Refusal | _Condition | None:
        if not self.may_speak_as(header.system):
            return Refusal.FOREIGN_SYSTEM
        if not self._mavlink1 and header.is_mavlink1:
            return Refusal.MAVLINK1_NOT_ALLOWED
        # A message in another definition than the dialect's is another message under the same number.
        key = header.msgid if header.is_known else ~header.msgid
        try:
            return self._decisions[key]
        except KeyError:
            return self._remember(key, self.decide(header.msgid, is_known=header.is_known))

    def decide(self, msgid: int, *, is_known: bool) -> Refusal | _Condition | None:
        """What holds for every frame of a message: it passes, is refused, or has conditions to meet."""
        rules = self._rules
        if msgid == dialect.SETUP_SIGNING:
            return Refusal.SETUP_SIGNING
        if rules.denies_all or msgid in rules.denied:
            return Refusal.MESSAGE_NOT_ALLOWED
        is_allowed = rules.allows_all or msgid in rules.allowed_numbers or (is_known and msgid in rules.allowed)
        only_commands = None
        only_reads_files = False
        if not is_allowed:
            if not is_known:
                return Refusal.UNKNOWN_MESSAGE
            only_reads_files = rules.reads_files and msgid == FILE_TRANSFER
        if not is_allowed and not only_reads_files:
            if msgid not in DIRECT_COMMANDS or not rules.allowed_commands:
                return Refusal.MESSAGE_NOT_ALLOWED
            only_commands = rules.allowed_commands
        never_commands = never_current = frozenset[int]()
        if rules.denied_commands:
            cannot_be_read = msgid in CARRIES_MANY_COMMANDS or (msgid in COMMAND_CARRIERS and not is_known)
            if cannot_be_read or SAME_AS_COMMAND.get(msgid) in rules.denied_commands:
                return Refusal.COMMAND_NOT_ALLOWED
            if msgid in COMMAND_CARRIERS:
                never_commands = rules.denied_commands
            if msgid in MISSION_ITEMS:
                at_once = {value for value, command in DONE_AT_ONCE.items() if command in rules.denied_commands}
                never_current = frozenset(at_once)
        condition = _Condition(
            only_commands,
            never_commands,
            never_current,
            only_reads_files=only_reads_files,
            refuses_ground_station=msgid == HEARTBEAT and not self._ground_station,
            per_second=self._rates.get(msgid),
        )
        return None if condition == _UNCONDITIONAL else condition

    def lets_act(self, name: str) -> bool:
        """Whether a frame of this message passes that changes something; with MAV_CMD_ in front, of this command."""
        if not name.startswith("MAV_CMD_"):
            verdict = self.decide(dialect.ids_by_name()[name], is_known=True)
            return verdict is None or (isinstance(verdict, _Condition) and not verdict.only_reads_files)
        verdicts = (self.decide(msgid, is_known=True) for msgid in DIRECT_COMMANDS)
        return any(
            verdict is None or (isinstance(verdict, _Condition) and verdict.takes_command(COMMANDS[name]))
            for verdict in verdicts
        )

    def _remember(self, key: int, verdict: Refusal | _Condition | None) -> Refusal | _Condition | None:
        if len(self._decisions) >= MAX_DECISIONS:
            self._decisions.clear()  # only someone who sends random message ids gets here
        self._decisions[key] = verdict
        return verdict

    def _unmet(self, condition: _Condition, frame: Frame, now: float, to: int) -> Refusal | None:
        breach = self._breach(condition, frame)
        # The rate comes last, so that only frames which would pass use it up.
        if (
            breach is not None
            or condition.per_second is None
            or self._takes_token(frame, condition.per_second, now, to)
        ):
            return breach
        return Refusal.RATE_LIMITED

    def _breach(self, condition: _Condition, frame: Frame) -> Refusal | None:
        if not condition.takes_command(frame.header.command):
            return Refusal.COMMAND_NOT_ALLOWED
        if condition.never_current and _payload_byte(frame, CURRENT_IN_MISSION_ITEM) in condition.never_current:
            return Refusal.COMMAND_NOT_ALLOWED
        if condition.only_reads_files and _payload_byte(frame, OPCODE_IN_FILE_TRANSFER) not in READING_OPCODES:
            return Refusal.FILE_WRITE_NOT_ALLOWED
        if condition.refuses_ground_station and claims_to_be_ground_station(frame):
            return Refusal.GROUND_STATION_NOT_ALLOWED
        return None

    def _takes_token(self, frame: Frame, per_second: float, now: float, to: int) -> bool:
        header = frame.header
        if not self._is_incoming:
            flow = (to, header.msgid, *flow_key(frame, kind_of(frame)))
            return _take(((self._buckets, flow, 1),), per_second, now)
        # A sender could choose another component for each frame, another target or instance too.
        one = (self._buckets, (header.msgid, header.system, header.component), 1)
        return _take((one, (self._of_systems, (header.msgid, header.system), SYSTEM_SHARE)), per_second, now)


_UNCONDITIONAL = _Condition()


def _take(limits: tuple[tuple[_Buckets, FlowKey, int], ...], per_second: float, now: float) -> bool:
    """Whether each of the buckets has a token for a frame: then one is taken from each, else from none.

    A bucket is given with its table, its key there, and how many times the rate it has.
    """
    levels = []
    for buckets, key, share in limits:
        # Two at least: a frame a second that comes a moment early must not be lost to a limit of one a second.
        most = share * max(2.0, per_second * BURST_S)
        tokens, updated_at = buckets.pop(key, (most, now))
        levels.append(min(most, tokens + max(0.0, now - updated_at) * per_second * share))
    passes = all(tokens >= 1 for tokens in levels)
    for (buckets, key, _), tokens in zip(limits, levels, strict=True):
        if len(buckets) >= MAX_BUCKETS:
            del buckets[next(iter(buckets))]  # the longest unused, so the first to be full again
        buckets[key] = (tokens - passes, now)
    return passes


def _payload_byte(frame: Frame, at: int) -> int:
    """A byte of a frame's payload; 0 where a MAVLink 2 sender cut it off, as for every receiver."""
    payload_at = 6 if frame.header.is_mavlink1 else 10
    return frame.raw[payload_at + at] if at < frame.raw[1] else 0


def claims_to_be_ground_station(frame: Frame) -> bool:
    """Whether a HEARTBEAT has the type of a ground station: PX4 takes any for a sign that its own still lives."""
    # Of one in another definition the type cannot be read.
    return not frame.header.is_known or _payload_byte(frame, TYPE_IN_HEARTBEAT) == MAV_TYPE_GCS


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
    conditions = {name: verdict for name in passing if isinstance(verdict := verdicts[name], _Condition)}
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
