"""``HOST:PORT``: which text is an address, and the errors for other text."""

from __future__ import annotations

import socket
from ipaddress import IPv4Address, IPv6Address

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from uavlinkd.system.addresses import AddressError, numeric_host, overlaps, parse_address


@pytest.mark.parametrize(
    ("text", "host", "port", "family"),
    [
        ("10.13.0.2:5790", "10.13.0.2", 5790, socket.AF_INET),
        ("0.0.0.0:1", "0.0.0.0", 1, socket.AF_INET),
        ("[::]:65535", "::", 65535, socket.AF_INET6),
        ("[2001:DB8::0:1]:5790", "2001:db8::1", 5790, socket.AF_INET6),
        ("[fe80::1%wlan0]:5790", "fe80::1%wlan0", 5790, socket.AF_INET6),
        ("localhost:5790", "127.0.0.1", 5790, socket.AF_INET),
        ("Drone-1.local:5790", "drone-1.local", 5790, socket.AF_UNSPEC),
        ("relay.example.org.:5790", "relay.example.org.", 5790, socket.AF_UNSPEC),
    ],
)
def test_address_is_parsed(text: str, host: str, port: int, family: socket.AddressFamily) -> None:
    """Numeric addresses have their canonical form, names lower case, and localhost is loopback."""
    address = parse_address(text, allow_names=True)
    assert (address.host, address.port, address.family) == (host, port, family)
    assert parse_address(str(address), allow_names=True) == address


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("10.13.0.2", "write 10.13.0.2:5790"),
        ("10.13.0.2:", "write 10.13.0.2:5790"),
        ("drone1", "has no port"),
        (":5790", "write 0.0.0.0:5790"),
        ("*:5790", "write 0.0.0.0:5790"),
        ("10.13.0.2:65536", "port from 1 to 65535"),
        ("10.13.0.2:5_7", "port from 1 to 65535"),
        ("10.13.0.2:٥٧٩٠", "port from 1 to 65535"),
        ("::1:5790", "without brackets"),
        ("::1", "without brackets"),
        ("1:2:3:4:5:6:7:8:5790", "write [1:2:3:4:5:6:7:8]:5790"),
        ("[::1]", "without brackets, or without a port"),
        ("[::1]5790", "has no port"),
        ("[drone1]:5790", "names without brackets"),
        ("[fe80::1%w lan]:5790", "not a network interface"),
        ("[fe80::1]:5790", "[fe80::1%wlan0]:5790"),
        ("[fe80::1%\x1b[2J]:5790", "not a network interface"),
        ("[::1:5790", "no closing bracket"),
        ("[10.13.0.2]:5790", "write 10.13.0.2:5790"),
        ("[::ffff:10.13.0.2]:5790", "10.13.0.2:5790"),
        ("[ff02::1]:5790", "multicast"),
        ("255.255.255.255:5790", "broadcast"),
        ("10.13.0.256:5790", "neither an IP address nor a host name"),
        ("10.13:5790", "neither an IP address nor a host name"),
        ("drone 1:5790", "neither an IP address nor a host name"),
        ("drone..local:5790", "neither an IP address nor a host name"),
        (f"{'a.' * 127}a:5790", "neither an IP address nor a host name"),
        (f"{'a' * 64}:5790", "neither an IP address nor a host name"),
    ],
)
def test_invalid_address_is_refused_with_advice(text: str, says: str) -> None:
    """The message names the mistake, and repeats only a recognised address."""
    with pytest.raises(AddressError) as caught:
        parse_address(text, allow_names=True)
    assert says in str(caught.value)


def test_name_is_refused_as_a_listening_address() -> None:
    """A resolver could map it to any address."""
    with pytest.raises(AddressError, match=r"numeric.*0\.0\.0\.0:5790"):
        parse_address("drone1.local:5790", allow_names=False)


def test_unrecognised_text_is_not_repeated() -> None:
    """A key in the wrong place does not reach a log."""
    key = "cHJpdmF0ZSBrZXkgdGhhdCBub2JvZHkgbWF5IHNlZSE="
    for text in (key, f"{key}:5790", f"[{key}]:5790", f"[{key}", f"10.13.0.2:{key}"):
        with pytest.raises(AddressError) as caught:
            parse_address(text, allow_names=True)
        assert key not in str(caught.value)


@pytest.mark.parametrize(
    ("a", "b", "clash"),
    [
        ("0.0.0.0:1", "0.0.0.0:1", True),
        ("0.0.0.0:1", "127.0.0.1:1", True),
        ("127.0.0.1:1", "0.0.0.0:1", True),
        ("127.0.0.1:1", "127.0.0.2:1", False),
        ("127.0.0.1:1", "127.0.0.1:2", False),
        ("[::]:1", "0.0.0.0:1", False),
        ("[::]:1", "[::1]:1", True),
    ],
)
def test_overlapping_addresses_cannot_both_be_bound(a: str, b: str, clash: bool) -> None:
    """A wildcard overlaps with each address of its family."""
    first, second = parse_address(a, allow_names=False), parse_address(b, allow_names=False)
    assert overlaps(first, second) is clash


@given(st.text(max_size=60))
def test_any_text_is_an_address_or_an_address_error(text: str) -> None:
    """No text causes another exception, and a parsed address survives a round trip."""
    try:
        address = parse_address(text, allow_names=True)
    except AddressError:
        return
    assert parse_address(str(address), allow_names=True) == address


@given(st.ip_addresses(), st.integers(1, 65535))
def test_every_unicast_address_is_parsed(ip: IPv4Address | IPv6Address, port: int) -> None:
    """Every unicast address of the standard library is valid, except IPv4-mapped and link-local IPv6."""
    refused = isinstance(ip, IPv6Address) and (ip.ipv4_mapped is not None or ip.is_link_local)
    assume(not ip.is_multicast and not refused and str(ip) != "255.255.255.255")
    text = f"[{ip}]:{port}" if ip.version == 6 else f"{ip}:{port}"
    address = parse_address(text, allow_names=False)
    assert (address.ip, address.port) == (ip, port)


@pytest.mark.parametrize(
    ("sockaddr", "host"),
    [
        (("127.0.0.1", 5790), "127.0.0.1"),
        (("2001:db8::1", 5790, 0, 0), "2001:db8::1"),
        (("fe80::1", 5790, 0, 2), "fe80::1%2"),
    ],
)
def test_numeric_host_keeps_the_zone(sockaddr: tuple[str | int, ...], host: str) -> None:
    """A link-local address is valid on one interface only."""
    assert numeric_host(sockaddr) == host
