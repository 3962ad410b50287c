"""Local MAVLink endpoints on UDP: ``udpin`` listens, ``udpout`` sends to one address.

The bytes of a sender are one stream, as on a serial line: a bridge may cut them into datagrams anywhere. A sender
with an unfinished frame has a :class:`StreamSplitter`, which holds less than a frame, for :data:`MAX_HOLD_S` at most.

Frames that arrived together are delivered together, so that they can share an envelope.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from math import inf

import structlog

from uavlinkd.io.ports import (
    CLIENT_SILENT_S,
    CLIENTS_PER_ENDPOINT,
    Endpoint,
    LocalPort,
    PortHandler,
    failure_name,
)
from uavlinkd.io.reader import Datagrams, Reader
from uavlinkd.io.resolver import LONGEST_WAIT_S, Resolved, keep_resolving
from uavlinkd.io.sockets import BindError, ErrorReports, family_of, send_again, udp_socket
from uavlinkd.mavlink.frames import Frame, StreamSplitter, parse_frames
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.protocol.path import SocketAddress, remote_of
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report
from uavlinkd.system.stall import STALE
from uavlinkd.system.tasks import keep_running

CLIENT_IDLE_S = 60.0  # `udpin` forgets a client that is silent for this long; even a listener sends heartbeats
REMOTE_SILENT_S = 5.0  # a `udpout` whose client is silent for this long looks its name up, and tries another address
ATTEMPT_S = 0.5  # it tries each address for this long at least, until the client answers
AVOIDED_S = 30.0  # an address that failed is not used again for this long, if there is another one
MAX_ADDRESSES = 8  # most addresses of a name that are used
MAX_HOLD_S = 2.0  # A frame in pieces may take this long: a frame of 280 bytes from a radio of 1,400 bit/s does.
MOST_STREAMS = 64
"""Most senders without a client's place whose unfinished frames are held. A new one displaces the oldest of these."""
LOCAL_DATAGRAM_BYTES = 296
"""Frames for one client share a datagram up to this size: MAVROS reads no more of a datagram and loses the rest
(libmavconn, MsgBuffer::MAX_SIZE)."""

_ANY = {socket.AF_INET: Address("0.0.0.0", 0), socket.AF_INET6: Address("::", 0)}


class UdpPort(LocalPort):
    """A client of a UDP endpoint."""

    endpoint: UdpEndpoint

    def __init__(self, endpoint: UdpEndpoint, name: str, address: SocketAddress, received_at: float | None) -> None:
        super().__init__(endpoint, name, received_at)
        self.address = address
        self.is_closed = False

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float = 0.0) -> None:
        """Send frames to the client, together where they fit. The endpoint counts what the kernel refuses."""
        delivered, endpoint = self.delivered, self.endpoint
        batch, count = b"", 0
        for frame in frames:
            data = frame.raw
            # As admit() does, without a call where nothing is open and no frame can begin within this one.
            if delivered.starts or data.count(b"\xfd") + data.count(b"\xfe") != 1:
                data = delivered.admit(frame, source, now)
                if not data:
                    continue
            if count and len(batch) + len(data) > LOCAL_DATAGRAM_BYTES:
                endpoint.send(batch, self.address, count)
                batch, count = b"", 0
            if len(data) > LOCAL_DATAGRAM_BYTES:  # a separator and the frame
                cut = len(data) - len(frame.raw)
                endpoint.send(data[:cut], self.address, 0)
                data = data[cut:]
            batch = batch + data if count else data
            count += 1
        if not count or self.is_closed:
            return
        try:
            endpoint.sendto(batch, self.address)
        except OSError as error:
            endpoint.on_send_error(batch, self.address, count, error)
        else:
            endpoint.bytes_sent += len(batch)
            endpoint.frames_sent += count


class UdpEndpoint(Endpoint):
    """A UDP socket and the clients at its other side.

    ``failures`` counts the kernel's errors: of those by ICMP, some of each second, not all.
    """

    def __init__(self, name: str, sock: socket.socket, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._on_frames = handler.on_frames
        self._use(sock)
        self._ports: dict[SocketAddress, UdpPort] = {}
        self._silent: set[LocalPort] = set()
        self._streams: dict[SocketAddress, StreamSplitter] = {}
        """Of the senders with an unfinished frame, the latest last."""

    @property
    def ports(self) -> Sequence[UdpPort]:
        return list(self._ports.values())

    def _use(self, sock: socket.socket) -> None:
        self._sock = sock
        self.sendto = sock.sendto
        self._reports = ErrorReports(sock)
        self._reader = Reader(sock, self.take, self._on_read_error, self.handler.stall)

    def start(self) -> None:
        self._reader.start()

    def gather(self, seconds: float) -> None:
        """Read once for all datagrams that arrive within ``seconds``, and not for each of them."""
        self._reader.gather(seconds)

    def take(self, datagrams: Datagrams, now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Deliver the frames of each client, in their order."""
        ports, streams = self._ports, self._streams
        received: dict[UdpPort | SocketAddress, list[Frame]] = {}
        stale: set[UdpPort | SocketAddress] | None = None
        for datagram, address in datagrams:
            sender = ports.get(address, address)
            if sender is address and not self._is_welcome(address):
                continue
            self.bytes_received += len(datagram)
            frames = received.get(sender)
            if frames is None:
                frames = received[sender] = []
            try:
                if streams and address in streams:
                    is_fresh = self._feed(datagram, address, frames, now, epoch)
                else:
                    end, fault = parse_frames(datagram, 0, frames, self.counters, is_expected=True)
                    is_fresh = fault is None or self._feed(datagram[end:], address, frames, now, epoch)
                if not is_fresh:
                    stale = (stale or set()) | {sender}
            except Exception as error:  # a fault costs this datagram
                report(error)
        for sender, frames in received.items():
            if not frames:
                continue
            try:
                if isinstance(sender, UdpPort):
                    port = sender if not sender.is_closed else self._admitted(sender.address, now)
                else:
                    port = self._admitted(sender, now)
                if port is not None:
                    if self._silent:
                        self._wake(port)
                    port.received_at = now
                    self._on_frames(port, frames, now, STALE if stale and sender in stale else epoch, waited_s)
            except Exception as error:  # of this client
                report(error)

    def _feed(self, data: bytes, address: SocketAddress, frames: list[Frame], now: float, epoch: int) -> bool:
        """Add the frames that these bytes of a sender complete. Returns whether they began in this epoch."""
        stream = self._streams.pop(address, None)
        if stream is None:
            stream = StreamSplitter(self.counters, max_hold_s=MAX_HOLD_S, gives_up=True)
        frames += stream.feed(data, now, epoch)
        if stream.pending_bytes:
            self._hold(stream, address)
        return stream.is_fresh

    def _admitted(self, address: SocketAddress, now: float) -> UdpPort | None:
        """The client at an address, perhaps a new one."""
        return self._ports.get(address) or self._admit(address, now)

    def _wake(self, port: UdpPort) -> None:
        """A client sent a frame: it is not silent any more."""
        if port in self._silent:
            self._silent.remove(port)
            self.handler.on_port_active(port)

    def _hold(self, stream: StreamSplitter, address: SocketAddress) -> None:
        """Keep an unfinished frame. Senders that are not clients cannot displace those of clients."""
        self._streams[address] = stream
        if len(self._streams) > MOST_STREAMS + len(self._ports):
            oldest = next(one for one in self._streams if one not in self._ports)
            self.counters.garbage_bytes += self._streams.pop(oldest).pending_bytes

    def send(self, datagram: bytes, address: SocketAddress, frames: int) -> None:
        """Send a datagram with so many frames, and count it."""
        if address not in self._ports:
            return
        try:
            self.sendto(datagram, address)
        except OSError as error:
            self.on_send_error(datagram, address, frames, error)
        else:
            self.bytes_sent += len(datagram)
            self.frames_sent += frames

    def on_send_error(self, datagram: bytes, address: SocketAddress, frames: int, error: OSError) -> None:
        """A datagram was not sent. Send it again if the error is about an earlier one; count any other."""
        last = send_again(self._sock, datagram, address, error, self._take_errors)
        if last is None:
            self.bytes_sent += len(datagram)
            self.frames_sent += frames
            return
        self.failures[failure_name(last)] += frames
        if last.errno != errno.ECONNREFUSED:  # which is about an earlier datagram, perhaps to another client
            self._on_failed(address, last.errno)

    def do_housekeeping(self, now: float) -> None:
        """Give up incomplete frames whose rest does not arrive, and have the kernel report errors again."""
        self._reports.renew()
        epoch = self.handler.stall.epoch
        for address, stream in list(self._streams.items()):
            frames = stream.give_up(now, epoch)
            if not stream.pending_bytes:
                del self._streams[address]
            port = self._admitted(address, now) if frames else None
            if port is not None:
                self._wake(port)
                port.received_at = now
                self._on_frames(port, frames, now, epoch if stream.is_fresh else STALE, 0.0)

    def close(self) -> None:
        super().close()
        for port in self._ports.values():
            port.is_closed = True
        self._ports.clear()
        self._close_socket()

    def _close_socket(self) -> None:
        self._reader.stop()
        self._sock.close()

    def _is_welcome(self, address: SocketAddress) -> bool:
        """Whether an address that is not a client's may become one. Datagrams from others are not looked at."""
        return True

    @abstractmethod
    def _admit(self, address: SocketAddress, now: float) -> UdpPort | None:
        """The new client at ``address``, which sent a genuine frame; None if the endpoint does not accept it."""

    def _open(self, address: SocketAddress, received_at: float | None) -> UdpPort:
        port = UdpPort(self, str(Address.of(address)), address, received_at)
        self.handler.on_port_opened(port)
        self._ports[address] = port
        return port

    def _forget(self, port: UdpPort) -> None:
        del self._ports[port.address]
        port.is_closed = True
        self._silent.discard(port)
        self.handler.on_port_closed(port)

    def _on_read_error(self, error: OSError) -> None:
        if not self._take_errors():
            self.failures[failure_name(error)] += 1

    def _take_errors(self) -> bool:
        """Count the errors of earlier datagrams. Returns whether there were any."""
        reports = self._reports.take()
        for address, number in reports:
            self.failures[errno.errorcode.get(number, "OSError")] += 1
            self._on_failed(address, number)
        self._reader.renew()
        return bool(reports)

    def _port_at(self, remote: SocketAddress) -> UdpPort | None:
        """The client at an address, whichever own address it asked."""
        return next((port for port in self._ports.values() if remote_of(port.address) == remote), None)

    def _on_failed(self, address: SocketAddress, number: int | None) -> None:
        """A datagram to a client did not arrive, because of the kernel's error with this number."""


class UdpServer(UdpEndpoint):
    """``udpin``: each address that recently sent a genuine frame is a client, up to a limit.

    A client whose port refuses a datagram is forgotten at once, or within a second if many do. Otherwise each restart
    of a client, with a new port, would add work for every frame. An attacker that forges the ICMP message can have a
    client forgotten until its next frame. Such an attacker could forge the client's frames too.
    """

    def do_housekeeping(self, now: float) -> None:
        """Forget idle clients, and report those that became silent."""
        super().do_housekeeping(now)
        for port in self.ports:
            silent_s = 0.0 if port.received_at is None else now - port.received_at
            if silent_s >= CLIENT_IDLE_S:
                self._forget(port)
            elif silent_s >= CLIENT_SILENT_S and port not in self._silent:
                self._silent.add(port)
                self.handler.on_port_silent(port)

    def _admit(self, address: SocketAddress, now: float) -> UdpPort | None:
        if (port := self._port_at(remote_of(address))) is not None:  # it asks another own address now
            del self._ports[port.address]
            port.address = address
            self._ports[address] = port
            return port
        if len(self._ports) >= CLIENTS_PER_ENDPOINT:
            silent = min(self._ports.values(), key=lambda port: port.received_at or -inf)
            if silent.received_at is None or now - silent.received_at < CLIENT_SILENT_S:
                self.failures["too_many_clients"] += 1
                return None
            self._forget(silent)
        return self._open(address, now)

    def _on_failed(self, address: SocketAddress, number: int | None) -> None:
        if number == errno.ECONNREFUSED and (port := self._port_at(address)) is not None:
            # Not within this call: it may be forwarding a frame of that client.
            asyncio.get_running_loop().call_soon(self._forget_refusing, port)

    def _forget_refusing(self, port: UdpPort) -> None:
        if self._ports.get(port.address) is port:
            self._forget(port)


class UdpClient(UdpEndpoint):
    """``udpout``: one client, at the configured address. If no process listens there, the kernel's ``ECONNREFUSED``
    is counted.

    The addresses of a name are used in turn until the client answers, without those that failed recently. A client
    that sends from one of them is served there from then on. All other datagrams are dropped, because any host of the
    network could send them: ``other_port`` counts those from the client's host, ``stranger`` the rest.
    """

    def __init__(self, name: str, remote: Address, handler: PortHandler) -> None:
        super().__init__(name, udp_socket(_ANY.get(remote.family, _ANY[socket.AF_INET])), handler)
        self.other_port = ""
        """The latest address with another port of the client's host that sent a datagram."""
        self._remote = remote
        self._addresses: Sequence[SocketAddress] = ()
        """The first one is used."""
        self._used_since = -inf
        self._failed_at: dict[SocketAddress, float] = {}

    def start(self) -> None:
        """Read whenever datagrams are there, and resolve the name again when its address is silent."""
        super().start()
        log = structlog.get_logger().bind(endpoint=self.name)
        following = partial(keep_resolving, self._remote, self._interval_s, self._on_resolved, log)
        self._task = keep_running(following, f"the search for {self._remote}")

    def do_housekeeping(self, now: float) -> None:
        """Use the next address of the name if this one is silent."""
        super().do_housekeeping(now)
        patience_s = REMOTE_SILENT_S if self._received_at >= self._used_since else ATTEMPT_S
        if now - max(self._received_at, self._used_since) >= patience_s:
            turns = [*self._addresses[1:], *self._addresses[:1]]
            self._use_first(sorted(turns, key=lambda one: now - self._failed_at.get(one, -inf) < AVOIDED_S), now)

    @property
    def _received_at(self) -> float:
        return max((port.received_at or -inf for port in self.ports), default=-inf)

    def _interval_s(self) -> float:
        """The interval between look-ups: none while the client answers."""
        is_silent = self._remote.ip is None and monotonic() - self._received_at >= REMOTE_SILENT_S
        return LONGEST_WAIT_S if is_silent or not self.ports else inf

    def _on_resolved(self, resolved: Resolved) -> bool:
        addresses = [address for _, address in resolved[:MAX_ADDRESSES]]
        self._failed_at = {one: at for one, at in self._failed_at.items() if one in addresses}
        return self._use_first(sorted(addresses, key=lambda one: one not in self._ports), monotonic())

    def _use_first(self, addresses: Sequence[SocketAddress], now: float) -> bool:
        """Serve the client at the first address whose family this machine has. Returns whether there is one."""
        for at, address in enumerate(addresses):
            if not self._has_socket(family_of(address[0])):
                continue
            self._addresses = addresses[at:]
            if address not in self._ports:
                self._used_since = now
                if self._ports:
                    _, port = self._ports.popitem()
                    port.address, port.name = address, str(Address.of(address))
                    self._ports[address] = port
                else:
                    self._open(address, None)
            return True
        return False

    def _has_socket(self, family: socket.AddressFamily) -> bool:
        """Change to a socket of this family. Returns False if this machine has no such sockets."""
        if family != self._sock.family:
            try:
                sock = udp_socket(_ANY[family])
            except BindError:
                self.failures["family_unavailable"] += 1
                return False
            gather_s = self._reader.gather_s
            self._close_socket()
            self._use(sock)
            self._reader.gather(gather_s)
            self._reader.start()
        return True

    def _is_welcome(self, address: SocketAddress) -> bool:
        if address in self._addresses:
            return True
        if any(address[0] == used[0] for used in self._ports):
            self.failures["other_port"] += 1
            self.other_port = str(Address.of(address))
        else:
            self.failures["stranger"] += 1
        return False

    def _admit(self, address: SocketAddress, now: float) -> UdpPort | None:
        if address in self._addresses:  # it may have been removed meanwhile
            self._use_first([address, *(one for one in self._addresses if one != address)], now)
        return self._ports.get(address)

    def _on_failed(self, address: SocketAddress, number: int | None) -> None:
        if address in self._addresses:
            self._failed_at[address] = monotonic()
