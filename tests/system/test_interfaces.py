"""The interfaces and routes of this machine, as the kernel reports them."""

from __future__ import annotations

import errno
import socket
import sys
from pathlib import Path

import pytest

from tests.needs import need
from uavlinkd.lab.sim.loopback_ports import has_ipv6
from uavlinkd.system import interfaces
from uavlinkd.system.interfaces import find_interface, interface_names, leads_to, specific_routes


@pytest.fixture(autouse=True)
def _on_linux() -> None:
    need(sys.platform == "linux", "Linux")


def test_loopback_is_read_with_its_addresses() -> None:
    """Its number, its state and its addresses."""
    loopback = find_interface("lo")
    assert loopback is not None
    assert loopback.ifindex == socket.if_nametoindex("lo")
    assert loopback.is_up
    assert loopback.hosts[0] == "127.0.0.1"
    assert ("::1" in loopback.hosts) is has_ipv6()


def test_names_need_no_netlink(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service's sandbox refuses such sockets, which the C library opens for the same question."""

    def refuse() -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "if_nameindex", refuse)
    names = interface_names()
    assert "lo" in names
    assert "Inter-|" not in names


def test_address_that_the_kernel_still_tests_is_not_usable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Duplicate address detection: a tentative address, and one that failed, cannot be a source."""
    number = socket.if_nametoindex("lo")
    rows = [("1", "80"), ("2", "c0"), ("3", "88"), ("4", "20")]
    table = tmp_path / "if_inet6"
    table.write_text(
        "".join(
            f"20010db800000000000000000000000{last} {number:02x} 40 00 {flags}       lo\n" for last, flags in rows
        )
        + f"20010db8000000000000000000000009 {number + 1:02x} 40 00 80     eth9\n"
    )
    monkeypatch.setattr(interfaces, "_IPV6_TABLE", table)
    loopback = find_interface("lo")
    assert loopback is not None
    assert [host for host in loopback.hosts if ":" in host] == ["2001:db8::1", "2001:db8::4"]


# Routes.


def stored(address: str) -> str:
    """As the kernel prints an IPv4 address: the number that the machine has in memory."""
    number = int.from_bytes(bytes(map(int, address.split("."))), sys.byteorder)
    return f"{number:08X}"


def row(interface: str, destination: str, flags: str, mask: str) -> str:
    """A row of the table of IPv4."""
    return "\t".join((interface, stored(destination), stored("0.0.0.0"), flags, "0", "0", "0", stored(mask), "0"))


@pytest.fixture
def tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Replacements for the kernel's two tables, which do not exist yet."""
    ipv4, ipv6 = tmp_path / "route", tmp_path / "ipv6_route"
    monkeypatch.setattr(interfaces, "_IPV4_ROUTES", ipv4)
    monkeypatch.setattr(interfaces, "_IPV6_ROUTES", ipv6)
    return ipv4, ipv6


def test_default_routes_and_refusals_do_not_count(tables: tuple[Path, Path]) -> None:
    """Nor does the loopback interface, nor a route that is down."""
    lines = [
        "Iface Destination Gateway Flags RefCnt Use Metric Mask",
        row("wwan0", "0.0.0.0", "0003", "0.0.0.0"),
        row("wlan0", "10.13.0.0", "0001", "255.255.0.0"),
        row("wlan0", "10.99.0.0", "0200", "255.255.0.0"),
        row("wlan0", "10.98.0.0", "0000", "255.255.0.0"),
        row("lo", "127.0.0.0", "0001", "255.0.0.0"),
    ]
    tables[0].write_text("\n".join(lines))
    present = specific_routes()
    assert [(str(route.network), route.interface) for route in present] == [("10.13.0.0/16", "wlan0")]
    assert leads_to(present, "10.13.255.1", None)
    assert leads_to(present, "10.13.255.1", "wlan0")
    assert not leads_to(present, "10.13.255.1", "wwan0")
    assert not leads_to(present, "10.99.0.1", None)
    assert not leads_to(present, "203.0.113.1", None)


def test_routes_of_ipv6(tables: tuple[Path, Path]) -> None:
    """The prefix and its length; an IPv4 address is in none of them."""
    zeros = "0" * 32
    lines = [
        f"fd13{28 * '0'} 40 {zeros} 00 {zeros} 00000100 00000001 00000000 00000001     mesh0",
        f"{zeros} 00 {zeros} 00 {zeros} 00000400 00000002 00000000 00000003     wwan0",
        f"fd14{28 * '0'} 40 {zeros} 00 {zeros} 00000100 00000001 00000000 00000201     mesh0",
    ]
    tables[1].write_text("\n".join(lines))
    present = specific_routes()
    assert [str(route.network) for route in present] == ["fd13::/64"]
    assert leads_to(present, "fd13::7", "mesh0")
    assert not leads_to(present, "fd14::7", "mesh0")
    assert not leads_to(present, "10.0.0.1", None)
