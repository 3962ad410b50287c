"""The interfaces of this machine, as the kernel reports them."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from tests.needs import need
from uavlinkd.lab.sim.loopback_ports import has_ipv6
from uavlinkd.system import interfaces
from uavlinkd.system.interfaces import find_interface, interface_of


@pytest.fixture(autouse=True)
def _on_linux() -> None:
    need(sys.platform == "linux", "Linux")


def test_loopback_is_read_with_its_addresses() -> None:
    """Its number, its state and its addresses; its end is not a modem's."""
    loopback = find_interface("lo")
    assert loopback is not None
    assert loopback.ifindex == socket.if_nametoindex("lo")
    assert (loopback.is_up, loopback.has_one_end) == (True, False)
    assert loopback.hosts[0] == "127.0.0.1"
    assert ("::1" in loopback.hosts) is has_ipv6()
    assert interface_of("127.0.0.1") == "lo"


def test_absent_interface_and_address() -> None:
    """Neither is an error."""
    assert find_interface("absent0") is None
    assert find_interface("longer-than-any-name") is None
    assert interface_of("192.0.2.77") is None


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


def test_kernel_without_ipv6(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """There is no table then."""
    monkeypatch.setattr(interfaces, "_IPV6_TABLE", tmp_path / "absent")
    loopback = find_interface("lo")
    assert loopback is not None
    assert loopback.hosts == ("127.0.0.1",)
