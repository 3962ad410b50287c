"""Datagrams to a daemon's port for stations, from a sender without a station's key, through the service itself.

No socket, disk or loop is there: the service gets what its reader would deliver. The attacker has recorded a genuine
initiation, a response to the daemon's own, and data of a session, and sends altered copies, replays and any bytes. If
it knows the daemon's public key, it repairs mac1. For every datagram one drop is counted, nothing leaves but cookies,
and no frame arrives. Then the genuine datagrams work, and their answers go to the station.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, cast
from unittest.mock import patch

from tests.fuzz.engine import Run, Script
from tests.stations.client import Client
from uavlinkd.config.model import EndpointConfig, StationsConfig
from uavlinkd.io.reader import Datagrams
from uavlinkd.io.url import StationUrl
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import Path as NetworkPath
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.stations import handshake, service
from uavlinkd.stations.endpoint import StationEndpoint
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic

THERE: Final[SocketAddress] = ("203.0.113.7", 40001)
SOURCES: Final[tuple[SocketAddress, ...]] = (THERE, ("203.0.113.7", 9), ("198.51.100.1", 40001), ("192.0.2.9", 1))
_PRIVATE: Final = bytes(range(1, 33))
_MACS: Final = 32
_KINDS: Final = (1, 2, 3, 4)
_SIZES: Final = (148, 92, 64, 32, 48, 160)


class Outside:
    """Everything around the service: its socket, reader, disk, timer and switch."""

    timer_at = float("inf")
    epoch = 0

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, SocketAddress]] = []
        self.drops: list[DropReason] = []
        self.frames: list[object] = []
        self.epochs: set[int] = set()
        self.deliver: Callable[[Datagrams, float, int, float], None]
        self.stall = self
        self._stamp = 0

    def reader(self, _sock: object, deliver: Any, *_: object, most: int) -> Outside:
        self.deliver = deliver
        return self

    def sendto(self, datagram: bytes, address: SocketAddress) -> None:
        self.sent.append((datagram, address))

    def timestamp(self) -> bytes:
        self._stamp += 1
        return (2**62 + self._stamp).to_bytes(8, "big") + bytes(4)

    def open(self) -> dict[bytes, SocketAddress]:
        return {self.station_key: THERE}

    station_key = b""

    def drop_datagram(self, reason: DropReason, name: str = "", path: NetworkPath | None = None) -> None:
        self.drops.append(reason)

    def on_frames(self, _port: object, frames: list[object], _now: float, epoch: int) -> None:
        self.frames += frames
        self.epochs.add(epoch)

    def ignore(self, *_: object) -> None:
        """What the rest of the daemon does."""

    start = stop = close = arm = on_port_opened = on_port_closed = follow = ignore


def _raise(error: BaseException) -> None:
    raise AssertionError(repr(error))


@contextmanager
def alone(outside: Outside) -> Iterator[None]:
    """Put the outside into the service. A fault that it would survive fails here."""
    parts: dict[str, Any] = {
        "udp_socket": lambda *_, **__: outside,
        "Reader": outside.reader,
        "StationDisk": lambda _: outside,
        "report": _raise,
    }
    with patch.multiple(service, **parts):
        yield


class Attacked:
    """A daemon with one station, with a session or before one."""

    def __init__(self, outside: Outside, *, has_session: bool) -> None:
        self.outside = outside
        own = handshake.StationKey(_PRIVATE)
        self.daemon_key, self.macs = own.key.public, own.macs
        self.client = client = Client(own.key.public)
        outside.station_key = client.key
        config = StationsConfig(Address("0.0.0.0", 51820), Secret(_PRIVATE), "10.66.0.1", Path("state"))
        self.stations = service.Stations(config, cast(Any, outside), cast(Any, outside))
        url = StationUrl("10.66.0.2", (14550,), client.key)
        self.endpoint: StationEndpoint = self.stations.endpoint(EndpointConfig("tablet", url, {}), cast(Any, outside))
        self.now = monotonic()
        self.endpoint.start()  # it initiates where the station was
        used: list[bytes] = []
        if has_session:
            used.append(client.initiation())
            self.offer(used[-1], THERE)
            client.on_response(outside.sent[-1][0])
            used.append(client.data(b""))
            self.offer(used[-1], THERE)
        initiation = outside.sent[0][0]
        genuine = client.udp(b"\xfd" * 20) if has_session else client.initiation()
        self.genuine = [client.on_initiation(initiation), genuine]
        self.recorded = [initiation, *(datagram for datagram, _ in outside.sent[1:]), *used, *self.genuine]
        outside.sent.clear()
        assert not outside.drops
        self.is_open = self.endpoint.is_open

    def offer(self, datagram: bytes, source: SocketAddress) -> None:
        """What the reader delivers."""
        self.now += 0.001
        self.outside.deliver([(datagram, source)], self.now, 0, 0.0)

    def check(self, datagram: bytes, source: SocketAddress) -> None:
        """Offer a hostile datagram: it is dropped, and at most a cookie leaves."""
        outside = self.outside
        self.offer(datagram, source)
        assert len(outside.drops) == 1, f"dropped {outside.drops}"
        for answer, to in outside.sent:
            assert outside.drops == [DropReason.COOKIE_REQUIRED], f"an answer to {outside.drops}"
            assert (answer[:4], to) == (handshake.COOKIE_REPLY, source)
            assert len(answer) <= len(datagram), "an answer longer than its message"
        assert self.endpoint.is_open is self.is_open
        assert not outside.frames
        outside.drops.clear()
        outside.sent.clear()

    def check_sequel(self) -> None:
        """The genuine datagrams work."""
        self.now += 10.0  # budgets are full again
        for datagram in self.genuine[::-1]:
            self.offer(datagram, THERE)
        assert not self.outside.drops, f"genuine, and dropped: {self.outside.drops}"
        assert self.endpoint.is_open
        assert all(to == THERE for _, to in self.outside.sent)


def make() -> Run:
    """A script is some datagrams to one daemon."""

    def run(data: bytes) -> None:
        script, outside = Script(data), Outside()
        with alone(outside):
            attacked = Attacked(outside, has_session=bool(script.byte() & 1))
            while script:
                how = script.byte()
                datagram = _datagram(script, attacked, how)
                if not any(_is_genuine(datagram, genuine) for genuine in attacked.genuine):
                    attacked.check(datagram, SOURCES[how >> 6])
            attacked.check_sequel()

    return run


def _is_genuine(datagram: bytes, genuine: bytes) -> bool:
    """Whether the daemon accepts it. The tags of WireGuard's handshake cover neither the sender's index nor the macs.

    An attacker on the path that alters the index makes a session that the station cannot use, as if it dropped the
    message.
    """
    if len(datagram) != len(genuine) or len(genuine) not in (handshake.INITIATION_BYTES, handshake.RESPONSE_BYTES):
        return datagram == genuine
    return datagram[:4] == genuine[:4] and datagram[8:-_MACS] == genuine[8:-_MACS]


def _datagram(script: Script, attacked: Attacked, how: int) -> bytes:
    match how & 7:
        case 0:
            return script.take(script.byte())
        case 1:
            size = _SIZES[script.byte() % len(_SIZES)]
            start = bytes((_KINDS[script.byte() % 4], 0, 0, 0))
            datagram = (start + script.take(script.byte() & 63)).ljust(size, b"\7" if how & 8 else b"\0")[:size]
        case _:
            altered = bytearray(attacked.recorded[script.byte() % len(attacked.recorded)])
            for _ in range(how & 3):
                altered[script.word() % len(altered)] ^= script.byte()
            if how & 4:
                altered = altered[: script.byte() + 1] if script.byte() & 1 else altered + script.take(16)
            datagram = bytes(altered)
    if how & 32 and len(datagram) > _MACS:
        return attacked.macs.add(datagram[:-_MACS], None)
    return datagram
