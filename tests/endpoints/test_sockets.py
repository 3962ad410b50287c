"""The options and errors of UDP sockets."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.needs import need
from tests.waiting import PATIENCE_S
from uavlinkd.endpoints.sockets import BUFFER_BYTES, BindError, network_socket, send_from_new_port, udp_socket
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.system.addresses import Address


def test_socket_is_bound_and_does_not_block() -> None:
    """Reading an empty socket returns at once."""
    port = free_port()
    with udp_socket(Address("127.0.0.1", port)) as sock:
        assert sock.getsockname() == ("127.0.0.1", port)
        with pytest.raises(BlockingIOError):
            sock.recv(1)


def test_there_is_room_for_bursts() -> None:
    """The buffers have the requested size, or the system's maximum. Linux doubles the value (socket(7))."""
    limits = {socket.SO_RCVBUF: "rmem_max", socket.SO_SNDBUF: "wmem_max"}
    with udp_socket(Address("127.0.0.1", 0)) as sock:
        for option, name in limits.items():
            limit = Path("/proc/sys/net/core", name)
            most = int(limit.read_text()) if limit.exists() else 0  # older kernels do not tell in a namespace
            assert sock.getsockopt(socket.SOL_SOCKET, option) >= 2 * min(BUFFER_BYTES, most)


def test_the_wildcard_of_ipv6_takes_no_ipv4() -> None:
    """[::]:P and 0.0.0.0:P are two sockets."""
    need(has_ipv6(), "an IPv6 loopback")
    port = free_port()
    with udp_socket(Address("::", port)), udp_socket(Address("0.0.0.0", port)):
        pass


def test_an_address_in_use_is_an_error() -> None:
    """One line with the address and the reason; the failed socket is closed."""
    with udp_socket(Address("127.0.0.1", 0)) as first:
        address = Address(*first.getsockname())
        with pytest.raises(BindError, match=rf"^cannot listen on {address}: Address already in use: .*another port$"):
            udp_socket(address)


def test_an_address_of_another_machine_is_an_error() -> None:
    """An address that this machine does not have."""
    with pytest.raises(BindError, match=r"^cannot listen on 192\.0\.2\.1:5790: "):
        udp_socket(Address("192.0.2.1", 5790))


@pytest.mark.parametrize("host", ["drone1.local", "fe80::1%no-such-if"])
def test_names_and_unknown_zones_are_errors(host: str) -> None:
    """Names are never looked up, and a zone must be an interface of this machine."""
    with pytest.raises(BindError, match=r"^cannot use "):
        udp_socket(Address(host, 5790))


@pytest.mark.parametrize("host", ["127.0.0.2", "::1"])
def test_datagram_from_a_new_port_comes_from_the_same_address(host: str) -> None:
    """Each from another port, which is closed afterwards."""
    need(host != "::1" or has_ipv6(), "an IPv6 loopback")
    with udp_socket(Address(host, 0)) as sock, udp_socket(Address(host, 0)) as receiver:
        receiver.settimeout(PATIENCE_S)
        send_from_new_port(sock, b"one", receiver.getsockname())
        data, source = receiver.recvfrom(64)
        assert (data, source[0]) == (b"one", host)
        assert source[1] not in (sock.getsockname()[1], receiver.getsockname()[1])
        with udp_socket(Address(host, source[1])):
            send_from_new_port(sock, b"two", receiver.getsockname())
            assert receiver.recvfrom(64)[1][1] != source[1]


def test_datagram_from_a_new_port_leaves_by_the_same_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    """A relay's networks may be bound to interfaces."""
    need(sys.platform == "linux", "Linux, to bind to interfaces")
    interfaces: list[bytes] = []

    class Watched(socket.socket):
        """Notes its interface when it sends."""

        def sendto(self, *args: Any) -> int:
            interfaces.append(self.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16))
            return super().sendto(*args)

    with network_socket(Address("127.0.0.1", 0), "lo", ()) as bound, udp_socket(Address("127.0.0.1", 0)) as free:
        monkeypatch.setattr(socket, "socket", Watched)
        for sock in (bound, free):
            send_from_new_port(sock, b"one", free.getsockname())
    assert [interface.rstrip(b"\0") for interface in interfaces] == [b"lo", b""]
