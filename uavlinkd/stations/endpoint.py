"""A station as the daemon sees it: an endpoint, whose clients are ports of the station's inner address."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from uavlinkd.io.ports import PortHandler, failure_name
from uavlinkd.io.udp_clients import DatagramEndpoint, UdpPort
from uavlinkd.io.url import StationUrl
from uavlinkd.mavlink.frames import split_payload
from uavlinkd.mavlink.payloads import may_be_old
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.stations.inner import MOST_PAYLOAD_BYTES

CLIENTS: Final = 8
"""Most clients of one station. Each gets all frames, along the same radio or Internet link: a captured station could
multiply them."""
CLIENT_IDLE_S: Final = 60.0
"""A client at a port that the file does not name is forgotten after this silence."""


class StationEndpoint(DatagramEndpoint):
    """The clients of one station. It has those at the ports in the file while the station has a session.

    ``send`` sends a payload to a client, and raises OSError. ``begin`` and ``finish`` start and end the tunnel.
    """

    is_station = True
    datagram_bytes = MOST_PAYLOAD_BYTES

    def __init__(
        self,
        name: str,
        url: StationUrl,
        handler: PortHandler,
        send: Callable[[bytes, SocketAddress], None],
        begin: Callable[[], None],
        finish: Callable[[], None],
    ) -> None:
        super().__init__(name, handler)
        self.is_open = False
        """Whether the station has a session."""
        self._host = url.host
        self._first = [(url.host, port) for port in url.ports]
        self.sendto, self._begin, self._finish = send, begin, finish

    def start(self) -> None:
        self._begin()

    def close(self) -> None:
        super().close()
        self._finish()

    def open(self) -> None:
        """The station has a session: its usual ports get frames, so that its software finds the vehicles."""
        self.is_open = True
        for address in self._first:
            if address not in self._ports:
                self._open(address, None)

    def end(self) -> None:
        """The station has no session any more."""
        self.is_open = False
        for port in self.ports:
            self._forget(port)

    def receive(self, payload: bytes, port: int, now: float, epoch: int, *, is_new: bool) -> bool:
        """Deliver the frames of a datagram from a port of the station; without evidence, only those that may be old.

        Returns whether there were others.
        """
        self.bytes_received += len(payload)
        frames = split_payload(payload, self.counters)
        passing = [frame for frame in frames if may_be_old(frame)]
        has_commands = len(passing) < len(frames)
        if not is_new:
            self.failures[DropReason.DOUBTFUL] += len(frames) - len(passing)
            frames = passing
        address = self._host, port
        client = (self._ports.get(address) or self._admit(address, now)) if frames else None
        if client is not None:
            self._wake(client)
            client.received_at = now
            self.handler.on_frames(client, frames, now, epoch)
        return has_commands

    def on_send_error(self, datagram: bytes, address: SocketAddress, frames: int, error: OSError) -> None:
        """Count frames that did not leave."""
        self.failures[failure_name(error)] += frames

    def do_housekeeping(self, now: float) -> None:
        """Forget clients that have gone."""
        for port in self.ports:
            if port.address not in self._first and now - (port.received_at or 0.0) >= CLIENT_IDLE_S:
                self._forget(port)

    def _admit(self, address: SocketAddress, now: float) -> UdpPort | None:
        if len(self._ports) >= CLIENTS:
            self.failures["too_many_clients"] += 1
            return None
        return self._open(address, now)
