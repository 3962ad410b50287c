"""Daemons and clients at IPv6 addresses."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest

from tests.needs import need
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6


def link_local_addresses() -> list[tuple[str, str]]:
    table = Path("/proc/net/if_inet6")
    text = table.read_text() if table.exists() else ""
    addresses_found = re.findall(r"^(fe80\w{28}) \w+ \w+ 20 (?:80|c0) +(\S+)$", text, re.M)
    return [
        (socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits)), interface) for digits, interface in addresses_found
    ]


async def cross(stage: Stage, a: DaemonProcess, b: DaemonProcess) -> None:
    """Start two daemons with an endpoint each, and have a frame cross in each direction."""
    into = [a.add_endpoint("autopilot"), b.add_endpoint("autopilot")]
    await stage.start(a, b)
    one, other = await stage.client(), await stage.client()
    one.send(frame(1, system=1), into[0])
    await a.until(lambda status: status["endpoints"]["autopilot"]["frames_received"] == 1)
    other.send(frame(2, system=2), into[1])
    await one.until(lambda: one.received == frame(2, system=2))
    one.send(frame(3, system=1), into[0])
    await other.until_received(frame(3, system=1))


async def test_endpoints_over_ipv6(stage: Stage) -> None:
    """Local clients on [::1], listening and connecting."""
    need(has_ipv6(), "an IPv6 loopback")
    a, b = stage.pair()
    into = a.add_endpoint("autopilot", f"udpin:[::1]:{free_port()}")
    ground = await stage.client("::1")
    b.add_endpoint("ground", f"udpout:{ground}")
    await stage.start(a, b)
    autopilot = await stage.client("::1")
    autopilot.send(frame(1), into)
    await ground.until(lambda: ground.received == frame(1))
    assert list((await a.status())["endpoints"]["autopilot"]["clients"]) == [str(autopilot)]


async def test_broadcast_address_is_named_as_the_cause(stage: Stage) -> None:
    """Its network may come up after ``check``."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    b.add_endpoint("ground", f"udpout:127.255.255.255:{free_port()}")
    await stage.start(a, b)
    autopilot = await stage.client()

    def send(status: Status) -> bool:
        autopilot.send(frame(1), into)
        return "client_unreachable" in {finding["cause"] for finding in status["findings"]}

    status = await b.until(send, timeout_s=10.0)
    (found,) = [finding for finding in status["findings"] if finding["name"] == "ground"]
    assert "cannot be reached: it fails (EACCES)" in found["text"]
    assert "this is a broadcast address" in found["remedy"]


async def test_a_link_between_link_local_addresses(stage: Stage) -> None:
    """A peer's link-local IPv6 address, as on an ad-hoc radio network, is called on the interface that it names."""
    addresses_found = link_local_addresses()
    if not addresses_found:  # not a matter of what is installed: a machine may well have none
        pytest.skip("needs an interface with a link-local IPv6 address")
    host, interface = addresses_found[0]
    ports = [free_port(), free_port()]
    a, b = (stage.daemon(f"drone{port}", [f"[::]:{port}"]) for port in ports)
    psk = stage.psk()
    a.add_peer(b, [f"[{host}%{interface}]:{ports[1]}"], psk)
    b.add_peer(a, [], psk)
    await cross(stage, a, b)
