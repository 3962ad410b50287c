"""Local MAVLink ports on UDP: ``udpin`` listens, ``udpout`` sends to one address.

A wake-up drains the socket and hands over everything at once, so frames that arrived together travel together.
"""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence

import structlog

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.ports import LocalPort, PortHandler, failure_name
from uavlinkd.endpoints.sockets import Batch, BindError, Reader, numeric_host, udp_socket
from uavlinkd.mavlink.policy.delivery import DeliveredStreams, Source
from uavlinkd.mavlink.frames import MAX_GAP_S, MIN_FRAME_BYTES, Frame, SplitCounters, StreamSplitter, split_datagram
from uavlinkd.system.resolver import Resolved, keep_resolving
from uavlinkd.system.stall import STALE
from uavlinkd.system.tasks import keep_running

CLIENTS_PER_ENDPOINT = 32
"""Programs that one ``udpin`` endpoint serves."""
CLIENT_IDLE_S = 60.0
"""A program that says nothing for this long is forgotten; even a listener sends a heartbeat each second."""
CLIENT_QUIET_S = 5.0
"""When all places are taken, one that was quiet for this long gives its own to a newcomer; no other does."""
REMOTE_SILENT_S = 5.0
"""A name whose address says nothing for this long is looked up again."""
LOCAL_DATAGRAM_BYTES = 296
"""Frames for one program share a datagram up to this size: MAVROS reads no more of one, and loses the rest
(libmavconn, MsgBuffer::MAX_SIZE)."""

_ANY = {socket.AF_INET: Address("0.0.0.0", 0), socket.AF_INET6: Address("::", 0)}

Sockaddr = tuple[str, int]


class UdpEndpoint(ABC):
    """A UDP socket, and the programs at its other side. The two kinds of it are below."""

    def __init__(self, name: str, sock: socket.socket, handler: PortHandler) -> None:
        self.name = name
        self.counters = SplitCounters()
        """What was found in the datagrams."""
        self.failures: Counter[str] = Counter()
        """What the kernel refused, by the name of the error; and ``stranger``, ``too_many_clients``."""
        self.bytes_received = 0
        self.bytes_sent = 0
        self.frames_sent = 0
        self._sock = sock
        self._handler = handler
        self._epoch = handler.stall.epoch  # of the last read
        self._gather_s = 0.0
        self._gathering: asyncio.TimerHandle | None = None
        self._delivered = DeliveredStreams()
        self._ports: dict[Sockaddr, LocalPort] = {}  # the longest silent first
        self._addresses: dict[LocalPort, Sockaddr] = {}
        self._cutters: dict[Sockaddr, StreamSplitter] = {}  # the programs that cut frames apart

    @property
    def ports(self) -> Sequence[LocalPort]:
        """Who is there now."""
        return list(self._ports.values())

    @property
    def address(self) -> Sockaddr:
        """Where the socket is bound."""
        host, port = self._sock.getsockname()[:2]
        return host, port

    def start(self) -> None:
        """Read whenever something is there."""
        self._watch(Reader(self._sock, self._count_failure, self._handler.stall))

    def gather(self, seconds: float) -> None:
        """One wake-up for all that comes within ``seconds``, rather than one for each datagram."""
        self._gather_s = seconds

    def _watch(self, reader: Reader) -> None:
        asyncio.get_running_loop().add_reader(self._sock, self._on_readable, reader)

    def _on_readable(self, reader: Reader) -> None:
        if self._gather_s:
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._sock)
            self._gathering = loop.call_later(self._gather_s, self._on_gathered, reader, self._gather_s)
        else:
            self.take(reader.read())

    def _on_gathered(self, reader: Reader, waited_s: float) -> None:
        self._gathering = None
        self._watch(reader)
        self.take(reader.read(), waited_s)

    def take(self, batch: Batch, waited_s: float = 0.0) -> None:
        """Hand over the frames of each sender in their order; the first of them has waited so long already."""
        datagrams, now, epoch = batch
        arrived: dict[Sockaddr, list[Frame]] = {}
        stale: set[Sockaddr] = set()
        counters = self.counters
        self._age(epoch)
        for datagram, source in datagrams:
            self.bytes_received += len(datagram)
            address = source if len(source) == 2 else (numeric_host(source), source[1])
            if self._cutters and address in self._cutters:
                splitter = self._cutters[address]
                if not splitter.is_fresh:
                    stale.add(address)
                frames = splitter.feed(datagram, now)
            else:
                garbage = counters.garbage_bytes
                frames = split_datagram(datagram, counters)
                if counters.garbage_bytes != garbage and address in self._ports:
                    self._follow_cuts(address, datagram, len(frames), now)
            if frames:
                if address in arrived:
                    arrived[address] += frames
                else:
                    arrived[address] = frames
        for address, frames in arrived.items():
            port = self._port_of(address, now)
            if port is not None:
                port.heard_at = now
                self._handler.on_frames(port, frames, now, STALE if address in stale else epoch, waited_s)

    def _follow_cuts(self, address: Sockaddr, datagram: bytes, found: int, now: float) -> None:
        """A program that is known sent what is no frame. Where its datagram ends amid one, the rest is to come.

        A bridge from a serial line may cut its bytes where it pleases. From then on they are taken as a stream.
        ``found``: how many frames were. Where fewer come before that end, the others stand after it, and it is none.
        A few bytes are a stray start rather; a bridge cuts elsewhere soon.
        """
        splitter = StreamSplitter(SplitCounters(), max_hold_s=MAX_GAP_S, gives_up=True)
        if len(splitter.feed(datagram, now)) == found and splitter.pending_bytes >= MIN_FRAME_BYTES:
            self.counters.garbage_bytes -= splitter.pending_bytes
            splitter.counters = self.counters
            self._cutters[address] = splitter

    def _age(self, epoch: int) -> None:
        """What programs cut apart began before a pause: then none of it is new."""
        if epoch != self._epoch:
            self._epoch = epoch
            for splitter in self._cutters.values():
                splitter.age()

    def write(self, port: LocalPort, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Send frames to one program, together where they fit. What the kernel does not take is counted."""
        address = self._addresses.get(port)
        if address is None:
            return
        admit = port.delivered.admit
        batch: list[bytes] = []
        size = 0
        for frame in frames:
            data = admit(frame, source, now)
            if not data:
                continue
            if size + len(data) > LOCAL_DATAGRAM_BYTES:
                if batch:
                    self._send(b"".join(batch), address, len(batch))
                    batch, size = [], 0
                if len(data) > LOCAL_DATAGRAM_BYTES:  # a separator and the frame
                    cut = len(data) - len(frame.raw)
                    self._send(data[:cut], address, 0)
                    data = data[cut:]
            batch.append(data)
            size += len(data)
        if batch:
            self._send(b"".join(batch), address, len(batch))

    def do_housekeeping(self, now: float) -> None:
        """Forget who is gone, and what waits for an end that does not come."""
        self._age(self._handler.stall.epoch)
        for address, splitter in self._cutters.items():
            epoch = self._epoch if splitter.is_fresh else STALE
            if frames := splitter.give_up(now):
                self._handler.on_frames(self._ports[address], frames, now, epoch)

    def close(self) -> None:
        """Close the socket."""
        if self._gathering is not None:
            self._gathering.cancel()
        asyncio.get_running_loop().remove_reader(self._sock)
        self._sock.close()

    @abstractmethod
    def _port_of(self, address: Sockaddr, now: float) -> LocalPort | None:
        """The program at ``address``, which just sent a genuine frame; None where it is not listened to."""

    def _open(self, address: Sockaddr, heard_at: float | None) -> LocalPort:
        name = str(Address(*address))
        port = LocalPort(self, name, heard_at, self._delivered.of(name))
        self._ports[address] = port
        self._addresses[port] = address
        self._handler.on_port_opened(port)
        return port

    def _forget(self, port: LocalPort) -> None:
        address = self._addresses.pop(port)
        del self._ports[address]
        self._cutters.pop(address, None)
        self._handler.on_port_closed(port)

    def _count_failure(self, error: OSError) -> None:
        self.failures[failure_name(error)] += 1

    def _send(self, datagram: bytes, address: Sockaddr, frames: int) -> None:
        try:
            self._sock.sendto(datagram, address)
        except OSError as error:
            self.failures[failure_name(error)] += frames
        else:
            self.bytes_sent += len(datagram)
            self.frames_sent += frames


class UdpServer(UdpEndpoint):
    """``udpin``: whoever sent a genuine frame lately is a port, up to a bound; each gets what comes."""

    def share_socket(self) -> socket.socket:
        """Its socket once more, for another endpoint in its place. Each is closed by its own."""
        return self._sock.dup()

    def do_housekeeping(self, now: float) -> None:
        """Forget the programs that went silent."""
        super().do_housekeeping(now)
        for port in self.ports:
            if port.heard_at is not None and now - port.heard_at >= CLIENT_IDLE_S:
                self._forget(port)

    def _port_of(self, address: Sockaddr, now: float) -> LocalPort | None:
        port = self._ports.pop(address, None)
        if port is not None:
            self._ports[address] = port  # now the last to have been silent
            return port
        if len(self._ports) >= CLIENTS_PER_ENDPOINT:
            silent = next(iter(self._ports.values()))
            if silent.heard_at is None or now - silent.heard_at < CLIENT_QUIET_S:
                self.failures["too_many_clients"] += 1
                return None
            self._forget(silent)
        return self._open(address, now)


class UdpClient(UdpEndpoint):
    """``udpout``: one program, at the address named; nothing is taken from any other."""

    def __init__(self, name: str, remote: Address, handler: PortHandler) -> None:
        super().__init__(name, udp_socket(_ANY.get(remote.family, _ANY[socket.AF_INET])), handler)
        self._remote = remote
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Read whenever something is there, and follow the name."""
        super().start()
        log = structlog.get_logger().bind(endpoint=self.name)
        following = keep_resolving((self._remote,), self._is_silent, self._on_resolved, log)
        self._task = keep_running(following, f"the search for {self._remote}")

    def close(self) -> None:
        """Close the socket."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    def _is_silent(self) -> bool:
        heard = [port.heard_at for port in self.ports if port.heard_at is not None]
        return self._remote.ip is None and (not heard or monotonic() - max(heard) >= REMOTE_SILENT_S)

    def _on_resolved(self, found: Resolved) -> bool:
        family, host, port = found[0]
        if (host, port) in self._ports:
            return True
        if family != self._sock.family:
            try:
                sock = udp_socket(_ANY[family])
            except BindError:
                self.failures["family_unavailable"] += 1
                return False
            super().close()
            self._sock = sock
            super().start()
        for gone in self.ports:
            self._forget(gone)
        self._open((host, port), None)
        return True

    def _port_of(self, address: Sockaddr, now: float) -> LocalPort | None:
        port = self._ports.get(address)
        if port is None:
            self.failures["stranger"] += 1
        return port
