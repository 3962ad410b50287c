"""Two real daemons that reach each other only along a relay."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Final, NamedTuple

from tests.daemon.frames import frame, heartbeat
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.udp import Client, Sockaddr, pour

MARKER: Final = 1 << 20
"""The number of the frame behind the first signs of life."""


class Flow(NamedTuple):
    """Frames of one system: the client that sends them, its endpoint, and the client that receives them."""

    system: int
    source: Client
    into: Sockaddr
    sink: Client

    async def pour(self, numbers: Iterable[int], window_bytes: int = 32768) -> None:
        """Send frames with these numbers. Assert that they arrive, and nothing else."""
        frames = [frame(number, self.system) for number in numbers]
        await pour(frames, self.source, self.into, self.sink, window_bytes=window_bytes)
        self.sink.clear()


class RelayedPair:
    """``one`` has the autopilot's client, ``other`` the ground station's. Neither has an address of the other.

    ``link`` is the section of both.
    """

    def __init__(self, stage: Stage, relay: DaemonProcess, **link: object) -> None:
        self.one, self.other = stage.daemon("drone0"), stage.daemon("drone1")
        self._stage = stage
        psk = stage.psk()
        for member, peer in ((self.one, self.other), (self.other, self.one)):
            member.config["link"].update(link)
            member.add_peer(peer, [], psk)
            member.config["relay"] = [
                {"name": relay.name, "public_key": relay.public_key, "addresses": [relay.address]}
            ]
            relay.config["member"].append({"name": member.name, "public_key": member.public_key})

    async def start(self) -> None:
        """Return when they are linked, and frames pass in both directions."""
        self._into = [daemon.add_endpoint("client") for daemon in (self.one, self.other)]
        self._clients = [await self._stage.client() for _ in self._into]
        await self._stage.start(self.one, self.other)
        for end in self.ends():
            end.source.send(heartbeat(end.system), end.into)  # makes the client known to its daemon
        for end in self.ends():
            while not end.sink.received:
                end.source.send(heartbeat(end.system), end.into)
                with suppress(TimeoutError):
                    await end.sink.until(lambda sink=end.sink: bool(sink.received), 0.2)  # type: ignore[misc]
        for end in self.ends():
            marker = frame(MARKER, end.system)
            end.source.send(marker, end.into)
            await end.sink.until_received(marker)
            end.sink.clear()

    def ends(self) -> tuple[Flow, Flow]:
        """Both directions."""
        (one, two), (into_one, into_two) = self._clients, self._into
        return Flow(1, one, into_one, two), Flow(2, two, into_two, one)
