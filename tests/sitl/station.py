"""A ground station: a UDP socket, a heartbeat per second, requests with retries, and a record of all frames.

It decodes with pymavlink, independently of the daemon.
"""

from __future__ import annotations

import asyncio
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from typing import Any, Self

from pymavlink.dialects.v20 import all as mavlink

from tests.processes.frames import sender_of
from tests.processes.udp import Sockaddr, open_socket
from tests.sitl.ledger import Passing, name_of, split

SYSTEM = 255
COMPONENT = 190
AUTOPILOT = 1
"""The component of an autopilot (MAV_COMP_ID_AUTOPILOT1)."""
COMMAND_RETRY_S = 1.5
HEARTBEAT_S = 1.0
REQUEST_EVERY_S = 0.1
"""A request and its acknowledgement are critical frames."""
ALWAYS_DECODED = frozenset({"HEARTBEAT", "GLOBAL_POSITION_INT", "SYS_STATUS", "STATUSTEXT", "EKF_STATUS_REPORT"})


def same_float32(one: float, two: float) -> bool:
    """Whether two values are the same on the wire. PX4 carries integers in the bytes of a float, which may be NaN."""
    return struct.pack("<f", one) == struct.pack("<f", two)


class RequestError(AssertionError):
    """The vehicle refused a request, or did not answer in time."""


class Inbox:
    """The messages of some types from a vehicle, in the order of arrival."""

    def __init__(self) -> None:
        self.queue: asyncio.Queue[Any] = asyncio.Queue()

    async def next(self, timeout_s: float) -> Any:
        """The next message; None if none arrives in time."""
        with suppress(TimeoutError):
            return await asyncio.wait_for(self.queue.get(), timeout_s)
        return None


class Station(asyncio.DatagramProtocol):
    """A ground station. It sends to where it received the target from, and broadcasts to all of these addresses."""

    system = SYSTEM

    def __init__(self) -> None:
        self.sent: list[Passing] = []
        self.received: list[Passing] = []
        self.latest: dict[tuple[int, str], Any] = {}
        """The newest message of each type that is always decoded, by system and type."""
        self.texts: list[tuple[float, int, str]] = []
        """Moment, system and text of each STATUSTEXT."""
        self.retries: Counter[str] = Counter()
        """Requests that were sent again, by message."""
        self.beats = True
        """Whether heartbeats are sent."""
        self._routes: dict[int, Sockaddr] = {}
        self.codec = mavlink.MAVLink(None, SYSTEM, COMPONENT)
        self.codec.robust_parsing = True
        self.bad_signatures = 0
        self._inboxes: list[tuple[frozenset[str], int, Inbox]] = []
        self._conditions: list[tuple[Callable[[], bool], asyncio.Future[None]]] = []
        self._sock = open_socket("127.0.0.1")
        self._transport: asyncio.BaseTransport
        self._beating: asyncio.Task[None]

    @property
    def address(self) -> Sockaddr:
        """Where it listens."""
        host, port = self._sock.getsockname()
        return host, port

    async def __aenter__(self) -> Self:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self._sock)
        self._beating = asyncio.create_task(self._beat())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._beating.cancel()
        with suppress(asyncio.CancelledError):
            await self._beating
        self._transport.close()

    async def _beat(self) -> None:
        while True:
            if self.beats:
                self.send(
                    mavlink.MAVLink_heartbeat_message(
                        mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                    )
                )
            await asyncio.sleep(HEARTBEAT_S)

    # Sending and receiving.

    def sign_with(self, key: bytes, timestamp: int) -> None:
        """Sign all frames from now on, and accept signed frames only. The timestamp counts 10 us since 2015."""
        signing = self.codec.signing
        signing.secret_key = key
        signing.sign_outgoing = True
        signing.link_id = 1
        signing.timestamp = timestamp

    def send(self, message: Any) -> bytes:
        """Send a message; the frame."""
        frame = bytes(message.pack(self.codec))
        self.codec.seq = (self.codec.seq + 1) % 256
        target = getattr(message, "target_system", 0)
        remotes = {self._routes[target]} if target in self._routes else set(self._routes.values())
        if remotes:
            self.sent.append(Passing(monotonic(), frame, target))
        for remote in remotes:
            self._sock.sendto(frame, remote)
        return frame

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        now = monotonic()
        for frame in split(data)[0]:
            self.received.append(Passing(now, frame))
            name = name_of(frame)
            system = sender_of(frame)
            self._routes[system] = addr[:2]
            wanted = [inbox for names, of, inbox in self._inboxes if name in names and of in (0, system)]
            is_judged = self.codec.signing.secret_key is not None  # by its signature, whatever it is
            if not wanted and name not in ALWAYS_DECODED and not is_judged:
                continue
            try:
                message = self.codec.decode(bytearray(frame))
            except mavlink.MAVError as error:
                self.bad_signatures += "signature" in str(error).lower()
                continue
            if name in ALWAYS_DECODED and (name != "HEARTBEAT" or message.get_srcComponent() == AUTOPILOT):
                self.latest[system, name] = message
            if name == "STATUSTEXT":
                self.texts.append((now, system, str(message.text)))
            for inbox in wanted:
                inbox.queue.put_nowait(message)
        for condition, future in self._conditions:
            if not future.done() and condition():
                future.set_result(None)

    @contextmanager
    def inbox(self, system: int, *names: str) -> Iterator[Inbox]:
        """Collect the messages of some types from a system (0: from any)."""
        inbox = Inbox()
        entry = (frozenset(names), system, inbox)
        self._inboxes.append(entry)
        try:
            yield inbox
        finally:
            self._inboxes.remove(entry)

    async def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for a condition, which is checked after each datagram.

        Raises:
            RequestError: it does not hold in time.
        """
        if condition():
            return
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._conditions.append((condition, future))
        try:
            await asyncio.wait_for(future, timeout_s)
        except TimeoutError:
            raise RequestError(f"{what}: not within {timeout_s:.0f} s; texts: {self.texts[-5:]}") from None
        finally:
            self._conditions = [entry for entry in self._conditions if entry[1] is not future]

    # Requests.

    async def command(self, system: int, number: int, *parameters: float, timeout_s: float = 60.0) -> int:
        """Send COMMAND_LONG until it is answered; the result (MAV_RESULT)."""
        seven = [*parameters, *[0.0] * (7 - len(parameters))]
        return await self._command(
            lambda attempt: mavlink.MAVLink_command_long_message(
                system, AUTOPILOT, number, min(attempt, 255), *seven
            ),
            system,
            number,
            timeout_s,
        )

    async def command_at(
        self,
        system: int,
        number: int,
        frame: int,
        four: tuple[float, ...],
        place: tuple[int, int, float],
        timeout_s: float = 60.0,
    ) -> int:
        """Send COMMAND_INT for a place until it is answered; the result."""
        return await self._command(
            lambda _: mavlink.MAVLink_command_int_message(system, AUTOPILOT, frame, number, 0, 0, *four, *place),
            system,
            number,
            timeout_s,
        )

    async def _command(self, make: Callable[[int], Any], system: int, number: int, timeout_s: float) -> int:
        deadline = monotonic() + timeout_s
        attempt = 0
        with self.inbox(system, "COMMAND_ACK") as inbox:
            while monotonic() < deadline:
                self.send(make(attempt))
                self.retries[f"command {number}"] += attempt > 0
                attempt += 1
                ends_at = monotonic() + COMMAND_RETRY_S
                while (left_s := ends_at - monotonic()) > 0:
                    ack = await inbox.next(left_s)
                    if ack is not None and ack.command == number and ack.result != mavlink.MAV_RESULT_IN_PROGRESS:
                        return int(ack.result)
        raise RequestError(f"command {number}: no answer within {timeout_s:.0f} s")

    async def must(self, system: int, number: int, *parameters: float, timeout_s: float = 60.0) -> None:
        """Send COMMAND_LONG, again while the vehicle refuses it for now.

        Raises:
            RequestError: it was not accepted in time.
        """
        deadline = monotonic() + timeout_s
        result = -1
        while monotonic() < deadline:
            result = await self.command(system, number, *parameters, timeout_s=timeout_s)
            if result == mavlink.MAV_RESULT_ACCEPTED:
                return
            await asyncio.sleep(1.0)
        raise RequestError(f"command {number} was refused with {result}; texts: {self.texts[-5:]}")

    @contextmanager
    def requesting(self, system: int) -> Iterator[None]:
        """Send requests in a steady rhythm: one heartbeat a second shows little of a gap."""

        async def request() -> None:
            parameters = (mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, *[0.0] * 6)
            number = mavlink.MAV_CMD_REQUEST_MESSAGE
            while True:
                self.send(mavlink.MAVLink_command_long_message(system, AUTOPILOT, number, 0, *parameters))
                await asyncio.sleep(REQUEST_EVERY_S)

        task = asyncio.create_task(request())
        try:
            yield
        finally:
            task.cancel()

    async def set_parameter(
        self, system: int, name: str, value: float, kind: int = mavlink.MAV_PARAM_TYPE_REAL32, timeout_s: float = 60.0
    ) -> None:
        """Set a parameter, and wait until the vehicle reports the value. ``value`` is as on the wire."""
        deadline = monotonic() + timeout_s
        with self.inbox(system, "PARAM_VALUE") as inbox:
            while monotonic() < deadline:
                self.send(mavlink.MAVLink_param_set_message(system, AUTOPILOT, name.encode(), value, kind))
                ends_at = monotonic() + COMMAND_RETRY_S
                while (left_s := ends_at - monotonic()) > 0:
                    answer = await inbox.next(left_s)
                    if answer is not None and answer.param_id == name and same_float32(answer.param_value, value):
                        return
        raise RequestError(f"{name} was not set to {value}")

    # Observations.

    def mode(self, system: int) -> int | None:
        """The custom mode in the newest heartbeat of a vehicle."""
        heartbeat = self.latest.get((system, "HEARTBEAT"))
        return None if heartbeat is None else int(heartbeat.custom_mode)

    def is_armed(self, system: int) -> bool:
        """Whether the newest heartbeat of a vehicle says that it is armed."""
        heartbeat = self.latest.get((system, "HEARTBEAT"))
        return heartbeat is not None and bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def position(self, system: int) -> tuple[int, int, float] | None:
        """Latitude and longitude in 1e-7 degrees, and height above home in m."""
        position = self.latest.get((system, "GLOBAL_POSITION_INT"))
        return None if position is None else (position.lat, position.lon, position.relative_alt / 1000)
