"""The stations of a daemon: their socket, who sends what there, and what is due."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Final, NamedTuple

from uavlinkd.config.model import EndpointConfig, StationsConfig
from uavlinkd.daemon.features import Feature
from uavlinkd.daemon.line import Line
from uavlinkd.io.ports import PortHandler, failure_name
from uavlinkd.io.reader import Datagrams, Reader
from uavlinkd.io.sockets import BindError, udp_socket
from uavlinkd.io.url import StationUrl
from uavlinkd.protocol.admission import Admission, CookieRequired, Message
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.path import Path, SocketAddress, remote_of
from uavlinkd.stations import handshake, inner
from uavlinkd.stations.endpoint import StationEndpoint
from uavlinkd.stations.session import DATA, HEADER_BYTES, TAG_BYTES
from uavlinkd.stations.state import StationDisk
from uavlinkd.stations.tunnel import Opened, Tunnel
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report, run
from uavlinkd.system.stall import StallWatch

MAVLINK_PORT: Final = 14550
"""The port of the daemon's inner address: ground stations answer there, and a client may begin there."""
ANSWERS_PER_S: Final = 10
"""Ping requests of one station that are answered."""
MOST_AT_ONCE: Final = 8
"""Datagrams of one read, of which each may be a stranger's: then the sockets of peers have a turn."""
_SOCKET: Final = -1  # the number of the socket in paths: none of the daemon's own


class Station(NamedTuple):
    """One station: its tunnel, its endpoint, and its budget of answers."""

    tunnel: Tunnel
    endpoint: StationEndpoint
    answers: TokenBucket


class Stations(Feature):
    """All stations of a daemon, at one socket. A datagram of anyone else gets no answer.

    ``line``: its timer is set when :attr:`next_at` is earlier than before, and it counts dropped datagrams.
    """

    def __init__(self, config: StationsConfig, stall: StallWatch, line: Line) -> None:
        self._config = config
        self._stall = stall
        self._line = line
        self._own = handshake.StationKey(config.private_key.reveal())
        self._cookies = handshake.StationCookies(self._own.macs, os.urandom, monotonic())
        self._admission = Admission(self._is_known, monotonic())
        self._indices: dict[int, Tunnel] = {}
        self._stations: dict[Tunnel, Station] = {}
        self._by_key: dict[bytes, Station] = {}
        self._disk = StationDisk(config.state_file)
        self._places: Mapping[bytes, SocketAddress] = {}  # where stations are, or were before a restart
        self._is_started = False

    # Life.

    def _open(self) -> None:
        """Bind the socket and read the file. Raises BindError."""
        self._places = self._disk.open()
        try:
            self._sock = udp_socket(self._config.listen, may_come_later=True)
        except BindError as error:
            raise BindError(f"stations.listen: {error}") from None
        self._reader = Reader(self._sock, self._receive, self._on_failure, self._stall, most=MOST_AT_ONCE)

    def endpoint(self, config: EndpointConfig, handler: PortHandler) -> StationEndpoint:
        """The endpoint of a station. The first one opens the socket. Raises BindError."""
        if not self._stations:
            self._open()
        url = config.url
        assert isinstance(url, StationUrl)
        ends = inner.Ends.of(url.host, self._config.address)
        tunnel = Tunnel(self._own, url.key, ends, os.urandom, self._indices, self._disk.timestamp)
        tunnel.address = self._places.get(url.key)
        send = partial(self._send_frames, tunnel)
        endpoint = StationEndpoint(config.name, url, handler, send, partial(self._start, tunnel), self._close)
        answers = TokenBucket(ANSWERS_PER_S, ANSWERS_PER_S, monotonic())
        self._stations[tunnel] = self._by_key[url.key] = Station(tunnel, endpoint, answers)
        self._admission.set_peers(len(self._stations))
        return endpoint

    def _start(self, tunnel: Tunnel) -> None:
        """Receive from now on, and make new keys with a station where it was last."""
        if not self._is_started:
            self._is_started = True
            self._reader.start()
        self._send_all(tunnel, tunnel.initiate(monotonic()))
        self._settle(tunnel)

    def _close(self) -> None:
        self._reader.stop()
        self._sock.close()

    # Datagrams in.

    def _receive(self, datagrams: Datagrams, now: float, epoch: int, waited_s: float) -> None:
        for datagram, address in datagrams:
            try:
                self._receive_one(datagram, address, now, epoch)
            except Drop as drop:
                self._line.drop_datagram(drop.reason, path=Path(_SOCKET, address))
            except Exception as error:  # a fault costs this datagram
                report(error)

    def _receive_one(self, datagram: bytes, address: SocketAddress, now: float, epoch: int) -> None:
        """Handle one datagram. Raises Drop."""
        kind, size = datagram[:4], len(datagram)
        if kind == DATA and size >= HEADER_BYTES + TAG_BYTES:
            self._receive_data(datagram, address, now, epoch)
        elif kind == handshake.INITIATION and size == handshake.INITIATION_BYTES:
            self._admit(datagram, Path(_SOCKET, address), now, is_response=False)
            initiation = handshake.read_initiation(self._own, datagram)
            station = self._by_key.get(initiation.static)
            if station is None:
                raise Drop(DropReason.UNKNOWN_PEER, initiation.static)
            self._send(station, station.tunnel.on_initiation(initiation, now), address)
            self._settle(station.tunnel)
        elif kind == handshake.RESPONSE and size == handshake.RESPONSE_BYTES:
            index = _index(datagram, 8)
            tunnel = self._named(index)  # first, so that a response to nothing takes no budget
            self._admit(datagram, Path(_SOCKET, address), now, is_response=True)
            self._send_all(tunnel, tunnel.on_response(datagram, index, now), address)
            self._follow(tunnel)
        elif kind == handshake.COOKIE_REPLY and size == handshake.COOKIE_REPLY_BYTES:
            index = _index(datagram, 4)
            self._named(index).on_cookie(datagram, index, now)
        else:
            raise Drop(DropReason.MALFORMED)

    def _named(self, index: int) -> Tunnel:
        """The tunnel that a received message names. Raises Drop."""
        if (tunnel := self._indices.get(index)) is None:
            raise Drop(DropReason.UNKNOWN_INDEX)
        return tunnel

    def _admit(self, datagram: bytes, path: Path, now: float, *, is_response: bool) -> None:
        """Whether a handshake message may cost a key exchange. Raises Drop."""
        if not self._own.macs.has_valid_mac1(datagram):
            raise Drop(DropReason.BAD_MAC1)
        try:
            message = Message(datagram, _index(datagram, 4), path, self._cookies)
            self._admission.admit(message, now, is_response=is_response)
        except CookieRequired as required:
            self._send(None, required.reply.datagram, path.address)
            raise

    def _receive_data(self, datagram: bytes, address: SocketAddress, now: float, epoch: int) -> None:
        index = _index(datagram, 4)
        tunnel = self._named(index)
        station = self._stations[tunnel]
        opened = tunnel.open(datagram, index, address, now)
        self._follow(tunnel)
        if opened.packet:
            self._receive_packet(station, opened, now, epoch)
            self._settle(tunnel)

    def _receive_packet(self, station: Station, opened: Opened, now: float, epoch: int) -> None:
        tunnel = station.tunnel
        match inner.parse(opened.packet, tunnel.ends):
            case inner.Datagram(source_port, port, payload) if port == MAVLINK_PORT:
                is_new = opened.is_new(now)
                commands = station.endpoint.receive(payload, source_port, now, epoch, is_new=is_new)
                tunnel.on_frames(now, is_new=is_new, has_commands=commands)
            case inner.Ping(is_answer=True, token=token) if tunnel.on_answer(opened, token):
                pass
            case inner.Ping(is_answer=False) as echo if station.answers.take(now):
                self._send_all(tunnel, tunnel.seal(inner.echo(tunnel.ends, echo.content, is_answer=True), now))
            case inner.Closed():
                station.endpoint.failures["ECONNREFUSED"] += 1
            case _:
                station.endpoint.failures["inner_packet"] += 1

    def _follow(self, tunnel: Tunnel) -> None:
        """The clients of a station are there while it has a session."""
        endpoint = self._stations[tunnel].endpoint
        if tunnel.is_open != endpoint.is_open:
            (endpoint.open if tunnel.is_open else endpoint.end)()

    def _is_known(self, place: SocketAddress) -> bool:
        return place in self._places.values()

    # Datagrams out.

    def _send_frames(self, tunnel: Tunnel, payload: bytes, client: SocketAddress) -> None:
        """Send frames to a client of a station. Raises OSError."""
        sealed = tunnel.seal(inner.udp(tunnel.ends, MAVLINK_PORT, client[1], payload), monotonic())
        if not sealed or tunnel.address is None:
            raise OSError(errno.ENOTCONN, "no session")
        self._sock.sendto(sealed[0], tunnel.address)
        self._settle(tunnel)

    def _send_all(self, tunnel: Tunnel, datagrams: Iterable[bytes], address: SocketAddress | None = None) -> None:
        """Send to where a station is."""
        to = address or tunnel.address
        if to is not None:
            for datagram in datagrams:
                self._send(self._stations[tunnel], datagram, to)

    def _send(self, station: Station | None, datagram: bytes, address: SocketAddress) -> None:
        try:
            self._sock.sendto(datagram, address)
        except OSError as error:
            if station is not None:
                station.endpoint.failures[failure_name(error)] += 1

    def _on_failure(self, error: OSError) -> None:
        """A read failed. On Linux the kernel reports no ICMP errors here: a stranger could cause them."""

    # Time.

    @property
    def next_at(self) -> float:
        """When :meth:`do_due` has something to do."""
        return min((tunnel.next_at for tunnel in self._stations), default=NEVER)

    def _settle(self, tunnel: Tunnel) -> None:
        if tunnel.next_at < self._line.timer_at:
            self._line.arm()

    def do_due(self, now: float) -> None:
        """Ask, renew keys, and end what is over."""
        for tunnel in self._stations:
            if now >= tunnel.next_at:
                run(self._do_due_of, tunnel, now)

    def _do_due_of(self, tunnel: Tunnel, now: float) -> None:
        self._send_all(tunnel, tunnel.do_due(now))
        self._follow(tunnel)

    def do_housekeeping(self, now: float) -> None:
        """Once a second."""
        self._places = {tunnel.key: remote_of(at) for tunnel in self._stations if (at := tunnel.address) is not None}
        self._disk.follow(self._places)


def _index(datagram: bytes, at: int) -> int:
    return int.from_bytes(datagram[at : at + 4], "little")
