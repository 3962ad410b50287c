"""The ground station of a test: it reads an autopilot's state by a link of its own, and keeps both links alive."""

from __future__ import annotations

import select
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.roles_links import RETRY_S, Link
from tests.waiting import PATIENCE_S
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.frames import Frame

ARMED: Final = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
HEARTBEAT_EVERY_S: Final = 0.2  # more often than 1/s: the simulator's time is faster
ANSWER_S: Final = 2.0
"""Between the answer to a request for a message and the message itself. Some autopilots accept, and send nothing."""
PLANS: Final = (
    mavlink.MAV_MISSION_TYPE_MISSION,
    mavlink.MAV_MISSION_TYPE_FENCE,
    mavlink.MAV_MISSION_TYPE_RALLY,
)
_DECODED: Final = frozenset({0, 2, 22, 33, 40, 42, 44, 47, 49, 51, 73, 77, 87, 242, 245, 253})
_ASK: Final = mavlink.MAV_CMD_REQUEST_MESSAGE


class StationError(Exception):
    """The autopilot does not answer, or refuses what the test needs."""


@dataclass(slots=True)
class Seen:
    """What the station last received."""

    latest: dict[str, Any] = field(default_factory=dict)
    """Messages by name."""
    number: Counter[str] = field(default_factory=Counter)
    """Frames of the autopilot by message."""
    answers: dict[int, int] = field(default_factory=dict)
    """The MAV_RESULT of commands, except that they are in progress."""
    parameters: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    """By index: the name, and the bytes of the value."""
    parameter_count: int = 0
    texts: list[str] = field(default_factory=list)


class Station:
    """One ground station with a link for itself (`own`), and the attacker's link, which it watches."""

    def __init__(self, own: Link, attacker: Link, vehicle: int = 1) -> None:
        self.own = own
        self.attacker = attacker
        self.vehicle = vehicle
        self.seen = Seen()
        self.is_silent = False
        """Whether it sends no HEARTBEAT, as a lost ground station."""
        self.check: Callable[[], None] = lambda: None
        """Raises an exception if the autopilot has ended."""
        self.on_message: Callable[[Any], None] = lambda message: None
        """Receives each decoded message of the autopilot."""
        self.sent_to_attacker: Counter[str] = Counter()
        """The autopilot's frames on the attacker's link, by message."""
        self._codec = mavlink.MAVLink(None, *own.sender)
        self._beat_at = 0.0
        self._plan_index = 0

    @property
    def time_s(self) -> float:
        """The autopilot's time since its start, which a simulator may let pass faster."""
        position = self.seen.latest.get("GLOBAL_POSITION_INT")
        return position.time_boot_ms / 1000 if position is not None else 0.0

    def send(self, message: Any) -> None:
        """Send a message on the station's own link."""
        self.own.send([bytes(message.pack(self._codec))])
        self._codec.seq = (self._codec.seq + 1) % 256

    def poll(self, timeout_s: float = 0.05) -> None:
        """Read what has arrived on both links, or wait for it."""
        self.check()
        if not self.is_silent and monotonic() >= self._beat_at:
            self._beat_at = monotonic() + HEARTBEAT_EVERY_S
            self.send(
                mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
            )
        ready, _, _ = select.select([self.own, self.attacker], [], [], timeout_s)
        for link in ready:
            frames = [one for one in link.read() if one.header.system == self.vehicle and one.header.component == 1]
            if link is self.own:
                for one in frames:
                    self._note(one)
            else:
                self.sent_to_attacker.update(name_of(one.header.msgid) for one in frames)

    def until(
        self,
        condition: Callable[[], bool],
        what: str,
        repeat: Callable[[], None] | None = None,
        every_s: float = RETRY_S,
    ) -> None:
        """Poll until a condition is true. `repeat` is called at once and then every so often.

        Raises:
            StationError: it does not become true within `PATIENCE_S`.
        """
        until, repeat_at = monotonic() + PATIENCE_S, 0.0
        while not condition():
            now = monotonic()
            if now >= until:
                raise StationError(f"waited in vain for {what}; last texts: {self.seen.texts[-5:]}")
            if repeat is not None and now >= repeat_at:
                repeat()
                repeat_at = now + every_s
            self.poll()

    def pass_time(self, seconds: float) -> None:
        """Let so many seconds of the autopilot's time pass."""
        until_s = self.time_s + seconds
        self.until(lambda: self.time_s >= until_s, f"{seconds:g} s of the autopilot's time")

    def wait_for_attacker(self) -> None:
        """Until the autopilot has read all that was sent on the attacker's link."""
        token = self.attacker.send_barrier()
        repeat_at, until = monotonic() + RETRY_S, monotonic() + PATIENCE_S
        while self.attacker.answered < token:
            self.poll()
            if monotonic() >= repeat_at:
                self.attacker.repeat_barrier()
                repeat_at = monotonic() + RETRY_S
            if monotonic() >= until:
                raise StationError("the autopilot does not answer on the attacker's link")

    def command(self, number: int, *parameters: float) -> int:
        """Send a COMMAND_LONG until it is answered; the result is a MAV_RESULT."""
        answers = self.seen.answers
        answers.pop(number, None)
        seven = (*parameters, *(0.0 for _ in range(7 - len(parameters))))
        self.until(
            lambda: number in answers,
            f"the answer to command {number}",
            lambda: self.send(mavlink.MAVLink_command_long_message(self.vehicle, 1, number, 0, *seven)),
        )
        return answers[number]

    def request(self, name: str, number: int) -> Any | None:
        """The current message of this name; None if the autopilot does not have it, or does not send it now."""
        self.seen.latest.pop(name, None)
        result = self.command(_ASK, number)
        if result != mavlink.MAV_RESULT_ACCEPTED:
            return None
        until = monotonic() + ANSWER_S
        while name not in self.seen.latest and monotonic() < until:
            self.poll()
        return self.seen.latest.get(name)

    def read_parameters(self) -> dict[str, bytes]:
        """Every parameter with the bytes of its value."""
        seen = self.seen
        seen.parameters.clear()
        seen.parameter_count = 0
        self._ask_for_parameters()
        known, quiet_since = 0, monotonic()
        until = monotonic() + 2 * PATIENCE_S
        while not seen.parameter_count or len(seen.parameters) < seen.parameter_count:
            self.poll()
            if len(seen.parameters) > known:
                known, quiet_since = len(seen.parameters), monotonic()
            if monotonic() - quiet_since > RETRY_S:
                self._ask_for_missing()
                quiet_since = monotonic()
            if monotonic() > until:
                raise StationError(f"only {known} of {seen.parameter_count} parameters came")
        return dict(seen.parameters.values())

    def read_plan(self, plan: int) -> tuple[bytes, ...]:
        """The items of a mission, fence or set of rally points, as the bytes of their fields."""
        seen = self.seen
        seen.latest.pop("MISSION_COUNT", None)
        self.until(
            lambda: _of_plan(seen.latest.get("MISSION_COUNT"), plan),
            f"MISSION_COUNT of plan {plan}",
            lambda: self.send(mavlink.MAVLink_mission_request_list_message(self.vehicle, 1, plan)),
            every_s=2 * RETRY_S,
        )
        items = []
        for index in range(seen.latest["MISSION_COUNT"].count):
            seen.latest.pop("MISSION_ITEM_INT", None)
            self._plan_index = index
            self.until(
                lambda: self._has_item(plan),
                f"item {index} of plan {plan}",
                lambda: self.send(
                    mavlink.MAVLink_mission_request_int_message(self.vehicle, 1, self._plan_index, plan)
                ),
            )
            items.append(repr(_without_header(seen.latest["MISSION_ITEM_INT"])).encode())
        self.send(mavlink.MAVLink_mission_ack_message(self.vehicle, 1, mavlink.MAV_MISSION_ACCEPTED, plan))
        return tuple(items)

    def write_plan(self, plan: int, items: list[Any]) -> None:
        """Upload MISSION_ITEM_INT messages.

        Raises:
            StationError: the autopilot refuses them.
        """
        seen = self.seen
        for name in ("MISSION_ACK", "MISSION_REQUEST"):
            seen.latest.pop(name, None)
        answered: set[int] = set()

        def answer(message: Any) -> None:
            if message.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT") and message.seq < len(items):
                self.send(items[message.seq])
                answered.add(message.seq)

        def begin() -> None:
            if not answered:
                self.send(mavlink.MAVLink_mission_count_message(self.vehicle, 1, len(items), plan))

        before, self.on_message = self.on_message, answer
        try:
            self.until(
                lambda: "MISSION_ACK" in seen.latest, f"MISSION_ACK of plan {plan}", begin, every_s=3 * RETRY_S
            )
        finally:
            self.on_message = before
        result = seen.latest["MISSION_ACK"].type
        if result != mavlink.MAV_MISSION_ACCEPTED:
            raise StationError(f"the autopilot refuses plan {plan}: {result}")

    def _ask_for_parameters(self) -> None:
        self.send(mavlink.MAVLink_param_request_list_message(self.vehicle, 1))

    def _ask_for_missing(self) -> None:
        seen = self.seen
        if not seen.parameter_count:
            self._ask_for_parameters()
            return
        missing = [index for index in range(seen.parameter_count) if index not in seen.parameters]
        for index in missing[:100]:
            self.send(mavlink.MAVLink_param_request_read_message(self.vehicle, 1, b"", index))

    def _has_item(self, plan: int) -> bool:
        item = self.seen.latest.get("MISSION_ITEM_INT")
        return _of_plan(item, plan) and item is not None and item.seq == self._plan_index

    def _note(self, one: Frame) -> None:
        seen = self.seen
        seen.number[name_of(one.header.msgid)] += 1
        if one.header.msgid not in _DECODED:
            return
        message = self._codec.decode(bytearray(one.raw))
        name = message.get_type()
        seen.latest[name] = message
        if name == "PARAM_VALUE":
            seen.parameter_count = message.param_count
            if message.param_index < message.param_count:
                value = one.raw[10:14].ljust(4, b"\0") if one.raw[0] == 0xFD else one.raw[6:10]
                seen.parameters[message.param_index] = (message.param_id, value)
        elif name == "COMMAND_ACK" and message.result != mavlink.MAV_RESULT_IN_PROGRESS:
            seen.answers[message.command] = message.result
        elif name == "STATUSTEXT":
            seen.texts.append(message.text)
        self.on_message(message)


def _of_plan(message: Any | None, plan: int) -> bool:
    return message is not None and message.mission_type == plan


def _without_header(message: Any) -> dict[str, object]:
    """The fields of an item, but for its target and for which item is the current one."""
    skipped = {"mavpackettype", "target_system", "target_component", "current"}
    return {name: value for name, value in message.to_dict().items() if name not in skipped}
