"""One direction of one policy: judges each frame, and counts what it refuses. The rules are explained in `policy`."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from uavlinkd.mavlink.dialect import COMMANDS, GROUPS, IDS, MESSAGES, SETUP_SIGNING
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame, payload_bytes
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.payloads import HEARTBEAT, claims_to_be_ground_station
from uavlinkd.mavlink.policy.secrets import OPCODES_WITHOUT_PATH, names_secrets
from uavlinkd.mavlink.policy.settings import FILE_TRANSFER, MAX_MSGID, Direction, Settings
from uavlinkd.protocol.drops import Attention, Reason
from uavlinkd.protocol.wire import Refused

ANY_OTHER: Final = -1  # stands for every message beyond those that are counted by themselves
# Limits of one policy in one direction:
MAX_COUNTED: Final = 1024  # message ids and reasons that are counted by themselves
MAX_BUCKETS: Final = 4096  # flows, and messages of systems, with a rate limit
MAX_DECISIONS: Final = 1024  # message ids whose decision is remembered
BURST_S: Final = 0.5  # how much of a second's frames may come at once
SYSTEM_SHARE: Final = 16  # what all components of a system may send of a message, in rates of one

NAMED_COMMANDS: Final = frozenset(COMMANDS.values())
DIRECT_COMMANDS: Final = frozenset((IDS["COMMAND_LONG"], IDS["COMMAND_INT"]))

# An autopilot answers these with hundreds of frames: components of a system share one rate.
REQUESTS_OF_LISTS: Final = frozenset((IDS["PARAM_REQUEST_LIST"], IDS["PARAM_EXT_REQUEST_LIST"]))

ARM: Final = COMMANDS["MAV_CMD_COMPONENT_ARM_DISARM"]

# A request for one message, by its number in the first parameter, a float at the payload's start. Some autopilots do
# more than answer: PX4 adds parameters to its list if it is asked for UAVIONIX_ADSB_OUT_CFG.
REQUEST_MESSAGE: Final = COMMANDS["MAV_CMD_REQUEST_MESSAGE"]

# ArduPilot executes such a mission item at once, by the value of `current`: it belongs to that command.
MISSION_ITEMS: Final = frozenset((IDS["MISSION_ITEM"], IDS["MISSION_ITEM_INT"]))
CURRENT_IN_MISSION_ITEM: Final = 35  # offset in the payload of both
DONE_AT_ONCE: Final[Mapping[int, int]] = {
    2: COMMANDS["MAV_CMD_DO_REPOSITION"],
    3: COMMANDS["MAV_CMD_DO_CHANGE_ALTITUDE"],
}

# What these carry is not their sender's own: a file, or the traffic of another wire, may well contain frames.
CARRY_ANYTHING: Final = frozenset(IDS[name] for group in ("files", "shell") for name in GROUPS[group])

# Behind three bytes of target: sequence 2, session 1, opcode 1, size 1, requested opcode 1, flags 2, offset 4, data.
OPCODE_IN_FILE_TRANSFER: Final = 6
DATA_IN_FILE_TRANSFER: Final = 15


class Refusal(Reason):
    """Why a policy refuses a frame. How a frame can hide another one: see `delivery`."""

    FOREIGN_SYSTEM = (
        "foreign_system",
        "the system id of the frame is not in system_ids",
        "from a system not in system_ids",
    )
    MESSAGE_NOT_ALLOWED = (
        "message_not_allowed",
        "the role, or the lists, do not allow the message",
        "not allowed by role or lists",
    )
    UNKNOWN_MESSAGE = (
        "unknown_message",
        "the dialect does not define the message, or not in this form: a list may allow its number",
        "unknown to the dialect",
    )
    COMMAND_NOT_ALLOWED = (
        "command_not_allowed",
        "the role, or the lists, do not allow the command",
        "commands not allowed by role or lists",
    )
    FILE_WRITE_NOT_ALLOWED = (
        "file_write_not_allowed",
        "the file transfer writes, or requests anything, where the policy allows only reading or only answers",
        "file requests not allowed",
    )
    SETUP_SIGNING = (
        "setup_signing",
        "the message contains a MAVLink signing key in clear, or requests a file with one, which never crosses",
        "with a signing key, or a request for its file",
    )
    MAVLINK1_NOT_ALLOWED = ("mavlink1_not_allowed", "the policy does not allow MAVLink 1", "MAVLink 1 frames")
    GROUND_STATION_NOT_ALLOWED = (
        "ground_station_not_allowed",
        "the heartbeat is that of a ground station, which the role does not allow",
        "heartbeats of a ground station",
    )
    RATE_LIMITED = ("rate_limited", "the messages exceed rate_in or rate_out", "above the rate limit")
    HIDDEN_FRAME = (
        "hidden_frame",
        "the frame is lost, as its bytes contain another one that the policy refuses: by accident, in a file with"
        " recorded MAVLink, or as an attack",
        "that hide a forbidden frame",
        Attention.EVERYDAY,
    )


WITHHELD: Final = frozenset[str](Refusal) - {Refusal.HIDDEN_FRAME}
"""Why frames to a peer or client are withheld as the file says. A healthy link has such frames all the time."""
CODES: Final[Mapping[Refusal, int]] = {refusal: code for code, refusal in enumerate(Refusal, 1)}
"""Of refusal reports (``protocol/README.md``, section 12), a part of the protocol: a code never changes its meaning.
New reasons follow the others."""
REFUSALS: Final[Mapping[int, Refusal]] = {code: refusal for refusal, code in CODES.items()}

_Buckets = dict[FlowKey, tuple[float, float]]  # tokens, and when that was, by what shares them


@dataclass(frozen=True, slots=True)
class Condition:
    """What a frame of one message must still meet."""

    # None: any. Else a message may be requested only if it may pass in the other direction.
    only_commands: frozenset[int] | None = None
    never_current: frozenset[int] = frozenset()  # values of a mission item's field
    only_opcodes: frozenset[int] | None = None  # of a file transfer; None: any
    protects_keys: bool = False  # a file transfer must not name a file of secrets
    refuses_ground_station: bool = False
    per_second: float | None = None


class Gate:
    """One direction of one policy: "in" from the peer or endpoint, or "out" to it."""

    opposite: Gate
    """The gate of the other direction, in which requested messages go. :class:`.Policy` sets it."""

    def __init__(self, settings: Settings, direction: Direction) -> None:
        self._rules = settings.rules[direction]
        self._rates = settings.rates[direction]
        self._is_incoming = direction == "in"
        self.systems = settings.systems if self._is_incoming else None  # whose frames are let pass; None: any
        self.passes_commands = self._rules.allows_command(ARM)  # which stands for the commands that fly a vehicle
        self._mavlink1 = settings.mavlink1
        self._ground_station = settings.ground_station or not self._is_incoming
        self._decisions: dict[int, Refusal | Condition | None] = {}
        self._buckets: _Buckets = {}
        self._of_systems: _Buckets = {}
        self.refused: Counter[tuple[int, Refusal]] = Counter()  # by message id (or ANY_OTHER) and reason
        # Of DIRECT_COMMANDS, by message id, command and reason. Numbers without a name share one entry (ANY_OTHER)
        # for each reason: they are bounded by themselves, and leave room for every command that a person knows.
        self.refused_commands: Counter[tuple[int, int, Refusal]] = Counter()
        self.refused_systems: Counter[int] = Counter()  # the senders' system ids of FOREIGN_SYSTEM
        self.totals: Counter[Refusal] = Counter()
        self.hiding = 0  # frames that hid others, without CARRY_ANYTHING
        self._reported: dict[tuple[int, int, int], int] = {}  # by message, command and code: the last result
        self._reported_sum = 0

    def check(self, frame: Frame, now: float, to: int = 0) -> Refusal | None:
        """None if the frame may pass, else why not, which is counted. `now` in seconds, monotonic.

        `to`: the client that an outgoing frame goes to, by its number. Each client has a rate limit of its own.
        """
        verdict = self._verdict(frame.header)
        if isinstance(verdict, Condition):
            refusal = self._breach(verdict, frame)
            # The rate comes last, so that only frames which would pass use it up.
            if refusal is None and verdict.per_second and not self._takes_token(frame, verdict.per_second, now, to):
                refusal = Refusal.RATE_LIMITED
        else:
            refusal = verdict
        if refusal is not None:
            self.count(frame.header, refusal)
        return refusal

    def count(self, header: Header, refusal: Refusal) -> None:
        """Count a frame that did not pass."""
        counted = (header.msgid, refusal)
        if len(self.refused) >= MAX_COUNTED and counted not in self.refused:
            counted = (ANY_OTHER, refusal)
        self.refused[counted] += 1
        self.totals[refusal] += 1
        self.hiding += refusal is Refusal.HIDDEN_FRAME and header.msgid not in CARRY_ANYTHING
        if refusal is Refusal.FOREIGN_SYSTEM:
            self.refused_systems[header.system] += 1
        if header.msgid in DIRECT_COMMANDS:
            number = header.command
            named = (ANY_OTHER, ANY_OTHER) if number not in NAMED_COMMANDS else (header.msgid, number)
            self.refused_commands[*named, refusal] += 1

    def changed_totals(self) -> list[Refused]:
        """The totals of refused frames that changed since the last call, in the codes of refusal reports.

        Messages that share one count are left out. Call it about once a second.
        """
        refused = self.totals.total()
        if refused == self._reported_sum:
            return []
        self._reported_sum = refused
        before, self._reported = self._reported, {entry[:3]: entry.total for entry in self._by_command()}
        return [Refused(*kind, total) for kind, total in self._reported.items() if before.get(kind) != total]

    def _by_command(self) -> Iterator[Refused]:
        with_command: Counter[tuple[int, Refusal]] = Counter()
        for (msgid, command, refusal), count in self.refused_commands.items():
            if msgid != ANY_OTHER and command > 0:  # others count for their message
                with_command[msgid, refusal] += count
                yield Refused(msgid, command, CODES[refusal], count)
        for (msgid, refusal), count in self.refused.items():
            rest = count - with_command[msgid, refusal]
            if msgid != ANY_OTHER and rest > 0:
                yield Refused(msgid, 0, CODES[refusal], rest)

    def permits(self, frame: Frame) -> bool:
        """Whether the frame may pass, at any rate. Counts nothing and uses up no rate."""
        verdict = self._verdict(frame.header)
        if isinstance(verdict, Condition):
            return self._breach(verdict, frame) is None
        return verdict is None

    @property
    def passes_unknown(self) -> bool:
        """Whether a message that the dialect does not define may pass, from some systems but not from all.

        Then a frame is valid by any CRC_EXTRA. If every frame may pass, the difference does not matter.
        """
        rules = self._rules
        passes_everything = rules.allows_all and self._mavlink1 and self._ground_station and self.systems is None
        return (rules.allows_all or bool(rules.allowed_numbers)) and not passes_everything

    @property
    def passes_nothing(self) -> bool:
        """Whether the rules allow no message at all, such as ``allow_in = []``."""
        rules = self._rules
        return not any(
            (rules.allows_all, rules.allowed, rules.allowed_numbers, rules.allowed_commands, rules.opcodes)
        )

    def may_speak_as(self, system: int) -> bool:
        """Whether frames of this system are let pass at all."""
        return self.systems is None or system in self.systems

    def always_passes(self, header: Header) -> bool:
        """Whether every frame with this header passes, at any rate: `check` need not be asked."""
        return self._verdict(header) is None

    def _verdict(self, header: Header) -> Refusal | Condition | None:
        if self.systems is not None and header.system not in self.systems:
            return Refusal.FOREIGN_SYSTEM
        if not self._mavlink1 and header.is_mavlink1:
            return Refusal.MAVLINK1_NOT_ALLOWED
        # A message in another definition than the dialect's is another message under the same number.
        key = header.msgid if header.is_known else ~header.msgid
        decisions = self._decisions
        if key not in decisions:
            if len(decisions) >= MAX_DECISIONS:
                decisions.clear()  # only a sender of random message ids causes this
            decisions[key] = self.decide(header.msgid, is_known=header.is_known)
        return decisions[key]

    def decide(self, msgid: int, *, is_known: bool) -> Refusal | Condition | None:
        """What holds for every frame of a message: it passes, is refused, or has conditions to meet."""
        rules = self._rules
        if msgid == SETUP_SIGNING:
            return Refusal.SETUP_SIGNING
        if self._rates.get(msgid) == 0:
            return Refusal.RATE_LIMITED
        is_allowed = rules.allows_all or msgid in rules.allowed_numbers or (is_known and msgid in rules.allowed)
        only_commands = only_opcodes = None
        if not is_allowed:
            if not is_known:
                return Refusal.UNKNOWN_MESSAGE
            if msgid == FILE_TRANSFER and rules.opcodes:
                only_opcodes = rules.opcodes
            elif msgid in DIRECT_COMMANDS and rules.allowed_commands:
                only_commands = rules.allowed_commands
            else:
                return Refusal.MESSAGE_NOT_ALLOWED
        never_current = frozenset[int]()
        if msgid in MISSION_ITEMS:
            never_current = frozenset(
                now for now, command in DONE_AT_ONCE.items() if not rules.allows_command(command)
            )
        condition = Condition(
            only_commands,
            never_current,
            only_opcodes,
            protects_keys=msgid == FILE_TRANSFER,
            refuses_ground_station=msgid == HEARTBEAT and not self._ground_station,
            per_second=self._rates.get(msgid),
        )
        return None if condition == _UNCONDITIONAL else condition

    def _breach(self, condition: Condition, frame: Frame) -> Refusal | None:
        if condition.only_commands is not None:
            command = frame.header.command
            if command not in condition.only_commands:
                return Refusal.COMMAND_NOT_ALLOWED
            if command == REQUEST_MESSAGE and not self._may_be_requested(frame):
                return Refusal.COMMAND_NOT_ALLOWED
        if condition.never_current:
            current = int.from_bytes(payload_bytes(frame, CURRENT_IN_MISSION_ITEM, 1), "little")
            if current in condition.never_current:
                return Refusal.COMMAND_NOT_ALLOWED
        if condition.protects_keys:
            opcode = int.from_bytes(payload_bytes(frame, OPCODE_IN_FILE_TRANSFER, 1), "little")
            if condition.only_opcodes is not None and opcode not in condition.only_opcodes:
                return Refusal.FILE_WRITE_NOT_ALLOWED
            if opcode not in OPCODES_WITHOUT_PATH and names_secrets(payload_bytes(frame, DATA_IN_FILE_TRANSFER, 239)):
                return Refusal.SETUP_SIGNING
        if condition.refuses_ground_station and claims_to_be_ground_station(frame):
            return Refusal.GROUND_STATION_NOT_ALLOWED
        return None

    def _may_be_requested(self, frame: Frame) -> bool:
        """Whether the requested message may pass in the other direction, and its number is valid."""
        (number,) = _FLOAT.unpack(payload_bytes(frame, 0, _FLOAT.size).ljust(_FLOAT.size, b"\0"))
        if not 0 <= number <= MAX_MSGID or number != int(number):  # neither is true of NaN
            return False
        return not isinstance(self.opposite.decide(int(number), is_known=int(number) in MESSAGES), Refusal)

    def _takes_token(self, frame: Frame, per_second: float, now: float, to: int) -> bool:
        header = frame.header
        if not self._is_incoming:
            flow = (to, header.msgid, *flow_key(frame))
            return _take(((self._buckets, flow, 1),), per_second, now)
        # A sender could choose another component for each frame, another target or instance too.
        one = (self._buckets, (header.msgid, header.system, header.component), 1)
        share = 1 if header.msgid in REQUESTS_OF_LISTS else SYSTEM_SHARE
        return _take((one, (self._of_systems, (header.msgid, header.system), share)), per_second, now)


_UNCONDITIONAL = Condition()
_FLOAT: Final = struct.Struct("<f")


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
