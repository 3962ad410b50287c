"""Frames made for tests, and a connection that stores frames."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.lab.sim.links import MavlinkConnection
from uavlinkd.system.addresses import Address


def frames(count: int, system_id: int = 1) -> list[bytes]:
    """Genuine frames of both versions, signed ones among them."""
    codec = mavlink.MAVLink(None, system_id, 1)
    codec.signing.secret_key = bytes(range(32))
    codec.signing.timestamp = 1
    made = []
    for number in range(count):
        message = mavlink.MAVLink_attitude_message(number, 0.1, 0.2, 0.3, 0, 0, number)
        codec.seq, codec.signing.sign_outgoing = number % 256, number % 3 == 2
        made.append(bytes(message.pack(codec, force_mavlink1=number % 3 == 1)))
    return made


class Collector:
    """A connection that stores each received frame, as on the wire."""

    def __init__(self, kind: EndpointKind, port: int) -> None:
        self.frames: list[bytes] = []
        self.link = MavlinkConnection(NetworkUrl(kind, Address("127.0.0.1", port)), self.frames.append)

    async def until(self, condition: Callable[[], bool]) -> None:
        await waiting.until(condition)

    def send(self, frame: bytes) -> bool:
        """Send to all receivers; False if there is no receiver."""
        return self.link.send(frame)

    async def __aenter__(self) -> Self:
        await self.link.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.link.close()
