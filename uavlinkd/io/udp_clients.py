"""The clients of an endpoint that receives datagrams: each address that sends MAVLink is one. No socket is here.

The bytes of a sender are one stream, as on a serial line: a bridge may cut them into datagrams anywhere. A sender
with an unfinished frame has a :class:`StreamSplitter`, which holds less than a frame, for :data:`MAX_HOLD_S` at most.

Frames that arrived together are delivered together, so that they can share an envelope.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

from uavlinkd.io.ports import Endpoint, LocalPort, PortHandler
from uavlinkd.io.reader import Datagrams
from uavlinkd.mavlink.frames import Frame, StreamSplitter, parse_frames
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.protocol.path import SocketAddress, remote_of
from uavlinkd.system.addresses import Address
from uavlinkd.system.guard import report
from uavlinkd.system.stall import STALE

MAX_HOLD_S = 2.0  # A frame in pieces may take this long: a frame of 280 bytes from a radio of 1,400 bit/s does.
MOST_STREAMS = 64
"""Most senders without a client's place whose unfinished frames are held. A new one displaces the oldest of these."""
LOCAL_DATAGRAM_BYTES = 296
"""MAVROS reads no more of a datagram, and loses the rest (libmavconn, MsgBuffer::MAX_SIZE)."""


class UdpPort(LocalPort):
    """A client of a UDP endpoint."""

    endpoint: DatagramEndpoint

    def __init__(
        self, endpoint: DatagramEndpoint, name: str, address: SocketAddress, received_at: float | None
    ) -> None:
        super().__init__(endpoint, name, received_at)
        self.address = address
        self.is_closed = False

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float = 0.0) -> None:
        """Send frames to the client, together where they fit. The endpoint counts what the kernel refuses."""
        delivered, endpoint = self.delivered, self.endpoint
        batch, count = b"", 0
        if endpoint.signing is not None:
            frames = endpoint.signing.sign(frames, source.name, is_genuine=self.is_genuine)
        for frame in frames:
            data = frame.raw
            # As admit() does, without a call where nothing is open and no frame can begin within this one.
            if delivered.starts or data.count(b"\xfd") + data.count(b"\xfe") != 1:
                data = delivered.admit(frame, source, now)
                if not data:
                    continue
            if count and len(batch) + len(data) > endpoint.datagram_bytes:
                endpoint.send(batch, self.address, count)
                batch, count = b"", 0
            if len(data) > endpoint.datagram_bytes:  # a separator and the frame
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


class DatagramEndpoint(Endpoint):
    """The clients that send datagrams to one endpoint, by their addresses."""

    sendto: Callable[[bytes, SocketAddress], object]
    """Sends a datagram to a client. Raises OSError."""
    datagram_bytes = LOCAL_DATAGRAM_BYTES
    """Frames for one client share a datagram up to this size."""

    def __init__(self, name: str, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._ports: dict[SocketAddress, UdpPort] = {}
        self._silent: set[LocalPort] = set()
        self._streams: dict[SocketAddress, StreamSplitter] = {}
        """Of the senders with an unfinished frame, the latest last."""

    @property
    def ports(self) -> Sequence[UdpPort]:
        return list(self._ports.values())

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
                    self.on_frames(port, frames, now, STALE if stale and sender in stale else epoch, waited_s)
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

    @abstractmethod
    def on_send_error(self, datagram: bytes, address: SocketAddress, frames: int, error: OSError) -> None:
        """A datagram with so many frames was not sent: count them."""

    def do_housekeeping(self, now: float) -> None:
        """Give up incomplete frames whose rest does not arrive."""
        epoch = self.handler.stall.epoch
        for address, stream in list(self._streams.items()):
            frames = stream.give_up(now, epoch)
            if not stream.pending_bytes:
                del self._streams[address]
            port = self._admitted(address, now) if frames else None
            if port is not None:
                self._wake(port)
                port.received_at = now
                self.on_frames(port, frames, now, epoch if stream.is_fresh else STALE, 0.0)

    def close(self) -> None:
        super().close()
        for port in self._ports.values():
            port.is_closed = True
        self._ports.clear()

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

    def _port_at(self, remote: SocketAddress) -> UdpPort | None:
        """The client at an address, whichever own address it asked."""
        return next((port for port in self._ports.values() if remote_of(port.address) == remote), None)
