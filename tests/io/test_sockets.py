"""Sockets: their options and errors, and addresses that are not there yet."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from functools import partial

import pytest
from structlog.testing import capture_logs

from tests.needs import need
from tests.processes.udp import open_socket
from tests.waiting import PATIENCE_S
from uavlinkd.io.sockets import BindError, is_here, udp_socket
from uavlinkd.io.tcp import tcp_listener
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.system.addresses import Address


def test_the_wildcard_of_ipv6_takes_no_ipv4() -> None:
    """[::]:P and 0.0.0.0:P are two sockets."""
    need(has_ipv6(), "an IPv6 loopback")
    port = free_port()
    with udp_socket(Address("::", port)), udp_socket(Address("0.0.0.0", port)):
        pass


def test_address_is_not_here_on_a_kernel_without_its_family(monkeypatch: pytest.MonkeyPatch) -> None:
    """No error: `check` asks about every address of a file."""

    def refuse(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "socket", refuse)
    assert not is_here(socket.AF_INET6, ("fd00::1", 0, 0, 0))


def test_wildcard_socket_answers_from_the_address_that_was_asked() -> None:
    """An address that the kernel prefers anyway is not part of the sender's address."""
    with udp_socket(Address("0.0.0.0", free_port())) as sock, open_socket("127.0.0.1") as asker:
        sock.settimeout(PATIENCE_S)
        asker.settimeout(PATIENCE_S)
        port = sock.getsockname()[1]
        for own in ("127.0.0.2", "127.0.0.1"):
            asker.sendto(b"question", (own, port))
            size, sender = sock.recvfrom_into(bytearray(64))
            assert (size, sender[:2]) == (8, asker.getsockname())
            assert sender[2:] == (() if own == "127.0.0.1" else (own,))
            sock.sendto(b"answer", sender)
            assert asker.recvfrom(64) == (b"answer", (own, port))


# An address that is not there yet: a drone's network comes up after its daemon, or never.


@pytest.mark.parametrize("listen", [partial(udp_socket, may_come_later=True), tcp_listener])
def test_absent_address_is_logged_once(listen: Callable[[Address], socket.socket]) -> None:
    """The address may also be a mistake. Without ``may_come_later`` it is an error."""
    address = Address("192.0.2.1", free_port())
    with capture_logs() as logs, listen(address) as sock:
        assert sock.getsockname() == (address.host, address.port)
    assert [(line["event"], line["address"]) for line in logs] == [("address_not_here_yet", str(address))]
    with capture_logs() as logs, listen(Address("127.0.0.1", 0)):
        assert logs == []
    with pytest.raises(BindError, match=r"^cannot listen on 192\.0\.2\.1:5790: "):
        udp_socket(Address("192.0.2.1", 5790))


def test_an_address_in_use_goes_to_no_other_socket() -> None:
    """Waiting for an address does not bypass the socket that has it, whether the address is there or not."""
    for host in ("127.0.0.1", "192.0.2.1"):
        address = Address(host, free_port())
        with (
            udp_socket(address, may_come_later=True),
            pytest.raises(BindError, match=rf"^cannot listen on {address}: Address already in use: "),
        ):
            udp_socket(address, may_come_later=True)


@pytest.mark.parametrize(
    ("host", "level", "option"),
    [("127.0.0.1", socket.IPPROTO_IP, socket.IP_RECVTOS), ("::1", socket.IPPROTO_IPV6, socket.IPV6_RECVTCLASS)],
)
def test_datagrams_go_before_video(host: str, level: int, option: int) -> None:
    """The class CS4 on the wire, and the highest priority in the queues that needs no capability."""
    with udp_socket(Address(host, 0)) as sender, udp_socket(Address(host, 0)) as receiver:
        receiver.setsockopt(level, option, 1)
        sender.sendto(b"frame", receiver.getsockname())
        receiver.setblocking(True)
        receiver.settimeout(PATIENCE_S)
        _, [(_, _, data)], _, _ = receiver.recvmsg(16, 64)
        assert data[0] == 32 << 2
        assert sender.getsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY) == 6
