"""Local MAVLink endpoints on UDP: ``udpin`` listens, ``udpout`` sends to one address."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Sequence
from functools import partial
from math import inf

import structlog

from uavlinkd.io.ports import (
    CLIENT_SILENT_S,
    CLIENTS_PER_ENDPOINT,
    PortHandler,
    failure_name,
)
from uavlinkd.io.reader import Reader
from uavlinkd.io.resolver import LONGEST_WAIT_S, Resolved, keep_resolving
from uavlinkd.io.sockets import BindError, ErrorReports, family_of, send_again, udp_socket
from uavlinkd.io.udp_clients import DatagramEndpoint, UdpPort
from uavlinkd.protocol.path import SocketAddress, remote_of
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.tasks import keep_running

CLIENT_IDLE_S = 60.0  # `udpin` forgets a client that is silent for this long; even a listener sends heartbeats
REMOTE_SILENT_S = 5.0  # a `udpout` whose client is silent for this long looks its name up, and tries another address
ATTEMPT_S = 0.5  # it tries each address for this long at least, until the client answers
AVOIDED_S = 30.0  # an address that failed is not used again for this long, if there is another one
MAX_ADDRESSES = 8  # most addresses of a name that are used

_ANY = {socket.AF_INET: Address("0.0.0.0", 0), socket.AF_INET6: Address("::", 0)}


class UdpEndpoint(DatagramEndpoint):
    """A UDP socket and the clients at its other side.

    ``failures`` counts the kernel's errors: of those by ICMP, some of each second, not all.
    """

    def __init__(self, name: str, sock: socket.socket, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._use(sock)

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
        """Give up incomplete frames, and have the kernel report errors again."""
        self._reports.renew()
        super().do_housekeeping(now)

    def close(self) -> None:
        super().close()
        self._close_socket()

    def _close_socket(self) -> None:
        self._reader.stop()
        self._sock.close()

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
