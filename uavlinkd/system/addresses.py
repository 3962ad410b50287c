"""``HOST:PORT``, ``[IPv6]:PORT`` and ``wss://HOST:PORT/PATH``, as they are written in a configuration."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any

DEFAULT_PORT = 5790  # The usual port of a daemon. It is a convention: a configuration always names the port.
IPV4_UDP_BYTES = 20 + 8  # header bytes of a datagram over IPv4 (RFC 791, RFC 768)
IPV6_UDP_BYTES = 40 + 8  # header bytes of a datagram over IPv6 (RFC 8200, RFC 768)

WEB_RESOURCE = "/uavlink"  # the usual path in the URL of a relay

_MAX_PORT = 65535
_RESOURCE = re.compile(r"[A-Za-z0-9._~/-]{0,64}")  # of a URL, behind its first slash
_PORT = re.compile(r"[0-9]{1,5}")
_ZONE = re.compile(r"[A-Za-z0-9_.-]{1,15}")
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
_MAX_NAME = 253


class AddressError(ValueError):
    """The text is not an address. The message says what to write.

    It repeats only recognised parts of the text, because a text in the wrong place may be a key.
    """


@dataclass(frozen=True, slots=True, order=True)
class Address:
    """A UDP or TCP address: a numeric host or a name, and a port."""

    host: str
    port: int
    resource: str = ""
    """Of a relay that is reached by TLS: the path in its URL."""

    @classmethod
    def of(cls, sockaddr: tuple[Any, ...]) -> Address:
        return cls(numeric_host(sockaddr), sockaddr[1])

    def __str__(self) -> str:
        if not self.port:  # of a line, which has no addresses
            return self.host
        place = f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"
        return f"wss://{place}{self.resource}" if self.resource else place

    @property
    def ip(self) -> IPv4Address | IPv6Address | None:
        """The numeric host; None for a name."""
        try:
            return ip_address(self.host)
        except ValueError:
            return None

    @property
    def family(self) -> socket.AddressFamily:
        """The address family; ``AF_UNSPEC`` for a name, which may have addresses of both families."""
        if (ip := self.ip) is None:
            return socket.AF_UNSPEC
        return socket.AF_INET if ip.version == 4 else socket.AF_INET6

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self.ip is not None and self.ip.is_loopback

    @property
    def is_wildcard(self) -> bool:
        """Whether it means every address of the machine."""
        return self.ip is not None and self.ip.is_unspecified

    def wildcard(self, *, of_other_version: bool = False) -> str:
        """The wildcard address with this port, of the same IP version or of the other one, as a file has it."""
        is_ipv6 = (self.family == socket.AF_INET6) is not of_other_version
        return f'"{"[::]" if is_ipv6 else "0.0.0.0"}:{self.port}"'


def overlaps(a: Address, b: Address) -> bool:
    """Whether two sockets cannot listen on both: same port, and same host or a wildcard."""
    if a.port != b.port or a.family != b.family:
        return False
    return a.ip == b.ip or a.is_wildcard or b.is_wildcard


def parse_address(text: str, *, allow_names: bool) -> Address:
    """Parse ``HOST:PORT``.

    ``localhost`` is always 127.0.0.1: a resolver that maps it elsewhere must not open the port to other machines.
    Raises AddressError, which says what to write.
    """
    host, port = _split(text)
    if host in ("", "*"):
        raise AddressError(f"names no host: write 0.0.0.0:{port} for all IPv4, [::]:{port} for all IPv6")
    try:
        ip = ip_address(host)
    except ValueError:
        if text.startswith("["):
            raise AddressError("has no IPv6 address in its brackets: write names without brackets") from None
        return Address("127.0.0.1", port) if host == "localhost" else _named(host, port, allow_names)
    if isinstance(ip, IPv6Address) and ip.scope_id is not None and not _ZONE.fullmatch(ip.scope_id):
        raise AddressError("has a zone that is not a network interface: write one, such as [fe80::1%wlan0]:5790")
    if isinstance(ip, IPv6Address) and not text.startswith("["):
        raise AddressError(f"an IPv6 address needs brackets: write [{ip}]:{port}")
    if isinstance(ip, IPv6Address) and ip.is_link_local and ip.scope_id is None:
        raise AddressError(
            "is link-local, valid on one network interface only, and does not name that: write"
            f" [{ip}%wlan0]:{port} with yours (`ip -brief link` lists them)"
        )
    if isinstance(ip, IPv4Address) and text.startswith("["):
        raise AddressError(f"only IPv6 addresses have brackets: write {ip}:{port}")
    if isinstance(ip, IPv6Address) and ip.ipv4_mapped is not None:
        raise AddressError(f"is an IPv4 address in IPv6 form: write {ip.ipv4_mapped}:{port}")
    if ip.is_multicast or host == "255.255.255.255":
        raise AddressError("is a multicast or broadcast address: write the address of one machine")
    return Address(str(ip), port)


def parse_place(text: str) -> Address:
    """Parse where a peer is reached: ``HOST:PORT``, or the URL of a relay. Raises AddressError."""
    if "://" not in text:
        return parse_address(text, allow_names=True)
    scheme, _, rest = text.partition("://")
    place, slash, resource = rest.partition("/")
    if scheme != "wss" or not _RESOURCE.fullmatch(resource):
        raise AddressError('is not the URL of a relay: write one such as "wss://relay.example.org:443/uavlink"')
    has_port = place.rpartition("]")[2].count(":") == 1
    address = parse_address(place if has_port else f"{place}:443", allow_names=True)
    return Address(address.host, address.port, slash + resource or WEB_RESOURCE)


def _split(text: str) -> tuple[str, int]:
    """Split into the host, without brackets, and a valid port."""
    if text.startswith("["):
        host, bracket, rest = text[1:].partition("]")
        if not bracket:
            raise AddressError(f'has no closing bracket: write "[ADDRESS]:PORT", such as [::]:{DEFAULT_PORT}')
        port_text = rest[1:] if rest.startswith(":") else ""
    else:
        host, colon, port_text = text.rpartition(":")
        if not colon or _is_ip(text):
            port_text = ""
    if not port_text:
        raise AddressError(_without_port(text))
    if not (_PORT.fullmatch(port_text) and 0 < int(port_text) <= _MAX_PORT):
        raise AddressError(f'does not end in a port: write "HOST:PORT" with a port from 1 to {_MAX_PORT}')
    return host, int(port_text)


def _is_ip(text: str) -> bool:
    """Whether the whole text is an IP address: ``::1:5790`` is one, although the author meant a port."""
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _without_port(text: str) -> str:
    host = text.removesuffix(":") if text.count(":") == 1 else text.strip("[]")
    if not _is_ip(host):
        return f'has no port: write "HOST:PORT"; uavlinkd\'s usual port is {DEFAULT_PORT}'
    if ":" in host:
        # In ::1:5790, the end may be a port or a part of the address.
        return f'is IPv6 without brackets, or without a port: write "[ADDRESS]:PORT", as in [::1]:{DEFAULT_PORT}'
    return f"has no port: write {host}:{DEFAULT_PORT}"


def _named(host: str, port: int, allowed: bool) -> Address:
    if not allowed:
        raise AddressError(
            f"must be a numeric address of this machine: write 0.0.0.0:{port} for all of IPv4,"
            f" [::]:{port} for all of IPv6, or one of its addresses"
        )
    labels = host.removesuffix(".").split(".")
    # A last label of digits alone is a mistyped IPv4 address (RFC 1123, section 2.1).
    if len(host) > _MAX_NAME or not all(map(_LABEL.fullmatch, labels)) or labels[-1].isdigit():
        raise AddressError('is neither an IP address nor a host name: write one, such as "10.13.0.2:5790"')
    return Address(host.lower(), port)


def numeric_host(sockaddr: tuple[Any, ...]) -> str:
    """The host of an Internet socket address, in a form that can be sent to.

    A link-local IPv6 address keeps its zone (``fe80::1%2``), because it is valid on that interface only.
    """
    host, zone = str(sockaddr[0]), sockaddr[3] if len(sockaddr) > 3 else 0  # (host, port, flow, zone)
    return f"{host}%{zone}" if zone else host
