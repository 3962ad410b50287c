"""Where daemons find each other: IPv6, names, stale addresses, peers that call."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest

from tests.daemon.harness import DaemonProcess, Stage, frame, free_port, has_ipv6, need


def link_local_addresses() -> list[tuple[str, str]]:
    """This machine's, each with its interface."""
    table = Path("/proc/net/if_inet6")
    text = table.read_text() if table.exists() else ""
    found = re.findall(r"^(fe80\w{28}) \w+ \w+ 20 (?:80|c0) +(\S+)$", text, re.M)
    return [(socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits)), interface) for digits, interface in found]


async def cross(stage: Stage, a: DaemonProcess, b: DaemonProcess) -> None:
    """Start two daemons with an endpoint each, and have a frame cross each way."""
    into = [a.add_endpoint("autopilot"), b.add_endpoint("autopilot")]
    await stage.start(a, b)
    one, other = await stage.program(), await stage.program()
    one.send(frame(1, system=1), into[0])
    await a.until(lambda status: status["endpoints"]["autopilot"]["frames_received"] == 1)
    other.send(frame(2, system=2), into[1])
    await one.until(lambda: one.received == frame(2, system=2))
    one.send(frame(3, system=1), into[0])
    await other.until(lambda: other.received == frame(3, system=1))


async def test_a_link_over_ipv6(stage: Stage) -> None:
    """Two daemons on [::1]."""
    need(has_ipv6(), "an IPv6 loopback")
    a, b = (stage.daemon(name, [f"[::1]:{free_port()}"]) for name in ("drone0", "drone1"))
    stage.introduce(a, b)
    await cross(stage, a, b)
    assert (await a.status())["peers"]["drone1"]["path"] == b.address


async def test_endpoints_over_ipv6(stage: Stage) -> None:
    """Local programs on [::1], listening and called."""
    need(has_ipv6(), "an IPv6 loopback")
    a, b = stage.pair()
    into = a.add_endpoint("autopilot", f"udpin:[::1]:{free_port()}")
    ground = await stage.program("::1")
    b.add_endpoint("ground", f"udpout:{ground}")
    await stage.start(a, b)
    autopilot = await stage.program("::1")
    autopilot.send(frame(1), into)
    await ground.until(lambda: ground.received == frame(1))
    assert list((await a.status())["endpoints"]["autopilot"]["programs"]) == [str(autopilot)]


async def test_a_link_between_link_local_addresses(stage: Stage) -> None:
    """A peer's link-local IPv6 address, as on an ad-hoc radio network, is called on the interface that it names."""
    found = link_local_addresses()
    if not found:  # not a matter of what is installed: a machine may well have none
        pytest.skip("needs an interface with a link-local IPv6 address")
    host, interface = found[0]
    ports = [free_port(), free_port()]
    a, b = (stage.daemon(f"drone{port}", [f"[::]:{port}"]) for port in ports)
    psk = stage.psk()
    a.add_peer(b, [f"[{host}%{interface}]:{ports[1]}"], psk)
    b.add_peer(a, [], psk)
    await cross(stage, a, b)


async def test_both_families_at_once(stage: Stage) -> None:
    """A daemon that listens on both families is reached over the one that the peer has."""
    need(has_ipv6(), "an IPv6 loopback")
    port = free_port()
    a = stage.daemon("drone0", [f"127.0.0.1:{port}", f"[::1]:{port}"])
    b = stage.daemon("drone1", [f"[::1]:{free_port()}"])
    psk = stage.psk()
    a.add_peer(b, [], psk)
    b.add_peer(a, a.config["listen"], psk)
    await cross(stage, a, b)
    assert (await b.status())["peers"]["drone0"]["path"] == f"[::1]:{port}"


async def test_the_wildcards_of_both_families_share_a_port(stage: Stage) -> None:
    """[::]:P takes no IPv4, so 0.0.0.0:P stands beside it."""
    need(has_ipv6(), "an IPv6 loopback")
    port = free_port()
    a = stage.daemon("drone0", [f"[::]:{port}", f"0.0.0.0:{port}"])
    b = stage.daemon("drone1", [])
    psk = stage.psk()
    a.add_peer(b, [], psk)
    b.add_peer(a, [f"127.0.0.1:{port}"], psk)
    await cross(stage, a, b)


async def test_a_peer_without_an_address_calls(stage: Stage) -> None:
    """One side has no address of the other and no listen address is needed at that one: it is called, and answers."""
    a, b = stage.daemon("ground"), stage.daemon("drone", [])
    psk = stage.psk()
    a.add_peer(b, [], psk)
    b.add_peer(a, [a.address], psk)
    await cross(stage, a, b)
    assert b.events("session_established")[0]["initiated_by"] == "us"


async def test_a_peer_without_an_address_is_found_again_after_either_restarts(stage: Stage) -> None:
    """The caller calls again when the called one has lost its state, and from another port after its own restart."""
    a, b = stage.daemon("ground"), stage.daemon("drone", [])
    psk = stage.psk()
    a.add_peer(b, [], psk)
    b.add_peer(a, [a.address], psk)
    await stage.start(a, b)
    await a.kill()
    await stage.start(a)
    await b.until_linked()
    old_path = (await a.status())["peers"]["drone"]["path"]
    await b.kill()
    await stage.start(b)
    await a.until(lambda status: status["peers"]["drone"]["path"] != old_path)
    await a.until_linked()


async def test_stale_addresses_come_first(stage: Stage) -> None:
    """Addresses that are not routed, closed, or mute are passed over for the one that answers."""
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    mute = await stage.program()
    psk = stage.psk()
    a.add_peer(b, ["192.0.2.1:5790", f"127.0.0.1:{free_port()}", str(mute), b.address], psk)
    b.add_peer(a, [], psk)
    await cross(stage, a, b)
    assert (await a.status())["peers"]["drone1"]["path"] == b.address


async def test_names_are_looked_up(stage: Stage) -> None:
    """``localhost`` and this machine's own name are addresses like others; one that does not resolve is told once."""
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    psk = stage.psk()
    port = b.sockaddr[1]
    a.add_peer(b, [f"no-such-drone.invalid:{port}", f"localhost:{port}"], psk)
    b.add_peer(a, [a.address.replace("127.0.0.1", "localhost")], psk)
    await cross(stage, a, b)
    assert (await a.until_logged("name_not_resolved"))["host"] == "no-such-drone.invalid"


async def test_the_own_name_of_this_machine(stage: Stage) -> None:
    """A name that the system resolves leads to the peer."""
    name = socket.gethostname()
    try:
        found = {each[4][0] for each in socket.getaddrinfo(name, 1, family=socket.AF_INET, type=socket.SOCK_DGRAM)}
    except OSError:
        found = set()
    if not found:
        pytest.skip("this machine does not know its own name")
    a, b = stage.daemon("drone0", []), stage.daemon("drone1", [f"0.0.0.0:{free_port()}"])
    psk = stage.psk()
    a.add_peer(b, [f"{name}:{b.sockaddr[1]}"], psk)
    b.add_peer(a, [], psk)
    await cross(stage, a, b)


async def test_an_address_of_a_family_that_no_socket_has_is_told(stage: Stage) -> None:
    """A peer at an IPv6 address, from a daemon that listens on IPv4 alone, is named in a warning."""
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    a.add_peer(b, ["[2001:db8::1]:5790"], stage.psk())
    await stage.start(a, linked=False)
    assert (await a.until_logged("peer_unreachable"))["peer"] == "drone1"
