"""Sockets on an address that is not there yet: a drone's network comes up after its daemon, or never."""

from __future__ import annotations

import subprocess
import sys

import pytest
from structlog.testing import capture_logs

from tests.needs import need
from uavlinkd.endpoints.sockets import BindError, udp_socket
from uavlinkd.endpoints.tcp import tcp_listener
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.system.addresses import Address

_IN_A_NETWORK_OF_ITS_OWN = """
import socket, subprocess, sys
from uavlinkd.system.addresses import Address
from uavlinkd.endpoints.sockets import udp_socket

host, bits = sys.argv[1].split("/")
with udp_socket(Address(host, 5790), may_come_later=True) as early:
    try:
        early.sendto(b"lost", (host, 5790))
        raise SystemExit("sent without a network")
    except OSError:
        pass
    for command in ("ip link set lo up", f"ip address add {host}/{bits} dev lo nodad"):
        subprocess.run(command.split(), check=True)
    with socket.socket(early.family, socket.SOCK_DGRAM) as other:
        early.settimeout(0.1)
        for _ in range(100):  # an interface that has just come up may still lose some
            other.sendto(b"question", (host, 5790))
            try:
                datagram, source = early.recvfrom(99)
                break
            except TimeoutError:
                pass
        early.sendto(b"answer", source)
        other.settimeout(60)
        answer, origin = other.recvfrom(99)
print(datagram.decode(), answer.decode(), origin[0])
"""


@pytest.mark.parametrize("address", ["192.0.2.1/32", "2001:db8::1/128"])
def test_socket_works_from_when_its_address_is_there(address: str) -> None:
    """Until then sending fails as without a network. Then datagrams go in both directions, from that address."""
    if ":" in address:
        need(has_ipv6(), "IPv6")
    new_network = ["unshare", "--map-root-user", "--net"]
    need(
        subprocess.run([*new_network, "ip", "link"], capture_output=True, check=False).returncode == 0,
        "unshare --net, and ip",
    )
    command = [*new_network, sys.executable, "-c", _IN_A_NETWORK_OF_ITS_OWN, address]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"question answer {address.partition('/')[0]}"


def test_it_is_said_once() -> None:
    """The address may also be a mistake."""
    address = Address("192.0.2.1", free_port())
    with capture_logs() as logs, udp_socket(address, may_come_later=True) as sock:
        assert sock.getsockname() == address.sockaddr
    assert [(line["event"], line["address"]) for line in logs] == [("address_not_here_yet", str(address))]
    with capture_logs() as logs, udp_socket(Address("127.0.0.1", 0), may_come_later=True):
        assert logs == []


def test_tcp_waits_for_its_address_too() -> None:
    """Listeners for clients or Prometheus at an address of another network do not keep the link from starting."""
    address = Address("192.0.2.1", free_port())
    with capture_logs() as logs, tcp_listener(address) as sock:
        assert sock.getsockname() == address.sockaddr
    assert [(line["event"], line["address"]) for line in logs] == [("address_not_here_yet", str(address))]


def test_an_address_in_use_goes_to_no_other_socket() -> None:
    """Waiting for an address does not bypass the socket that has it, whether the address is there or not."""
    for host in ("127.0.0.1", "192.0.2.1"):
        address = Address(host, free_port())
        with (
            udp_socket(address, may_come_later=True),
            pytest.raises(BindError, match=rf"^cannot listen on {address}: Address already in use: "),
        ):
            udp_socket(address, may_come_later=True)
