"""MAVLink URLs: the notation of local endpoints.

::

    udpin:HOST:PORT     listen for datagrams           udpin:127.0.0.1:14550
    udpout:HOST:PORT    send datagrams there           udpout:127.0.0.1:14540
    tcpin:HOST:PORT     listen for connections         tcpin:127.0.0.1:5760
    tcp:HOST:PORT       connect there                  tcp:127.0.0.1:5760
    serial:DEVICE:BAUD  a serial port                  serial:/dev/ttyACM0:57600

``udpin://HOST:PORT`` and so on mean the same. Other software has other spellings. They are refused, and the message
says what to write, because some (``udp:``) mean opposite things in different software.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from uavlinkd.system.addresses import Address, AddressError, parse_address


class UrlError(ValueError):
    """The text is not an endpoint URL. The message says what to write."""


class EndpointKind(StrEnum):
    """The type of an endpoint. The value is the URL's scheme."""

    UDPIN = "udpin"
    UDPOUT = "udpout"
    TCP = "tcp"
    TCPIN = "tcpin"
    SERIAL = "serial"
    STATION = "station"


_LISTENING = frozenset({EndpointKind.UDPIN, EndpointKind.TCPIN})


@dataclass(frozen=True, slots=True)
class NetworkUrl:
    """An endpoint on UDP or TCP. The host of a listening one is numeric."""

    kind: EndpointKind
    address: Address

    def __str__(self) -> str:
        return f"{self.kind}:{self.address}"

    @property
    def listens(self) -> bool:
        return self.kind in _LISTENING

    @property
    def is_udp(self) -> bool:
        return self.kind in (EndpointKind.UDPIN, EndpointKind.UDPOUT)

    @property
    def is_exposed(self) -> bool:
        """Whether its plain MAVLink can leave this machine, or arrive from another one."""
        return not self.address.is_loopback


@dataclass(frozen=True, slots=True)
class SerialUrl:
    device: str
    baud: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.device}:{self.baud}"

    kind: ClassVar = EndpointKind.SERIAL
    listens: ClassVar = False  # a wire has one other end
    is_exposed: ClassVar = False  # access to a wire needs presence


@dataclass(frozen=True, slots=True)
class StationUrl:
    """The inner address of a station that speaks WireGuard, the ports of its software, and its key."""

    host: str
    ports: tuple[int, ...]
    key: bytes

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}"

    kind: ClassVar = EndpointKind.STATION
    listens: ClassVar = True
    is_exposed: ClassVar = False  # only the holder of the key is there


EndpointUrl = NetworkUrl | SerialUrl | StationUrl

_MAX_BAUD = 20_000_000
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:/dev/DEVICE:BAUD"

_TWO_ADDRESSES = (
    "one address, not BIND@REMOTE: write udpin:HOST:PORT with the address to listen on, which serves every client"
    " that sends there, or udpout:HOST:PORT with the remote address"
)
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9_-]*):(//)?(.*)", re.DOTALL)
_BARE_DEVICE = re.compile(r"(/dev/[\x21-\x2b\x2d-\x39\x3b-\x7e]+)(?:[,:](\d+))?")
_BARE_ADDRESS = re.compile(r"[0-9.]+:\d+|\[[0-9A-Fa-f:.]+\]:\d+|\d+")
_DEVICE = re.compile(r"/[\x21-\x7e]+")


def parse_url(text: str) -> EndpointUrl:
    """Parse a URL. ``str()`` of the result gives its usual form. Raises UrlError, which says what to write."""
    if device := _BARE_DEVICE.fullmatch(text):
        raise UrlError(f"is only a device: write serial:{device[1]}:{device[2] or 57600}")
    if _BARE_ADDRESS.fullmatch(text):
        where = text if ":" in text else f"127.0.0.1:{text}"
        raise UrlError(f"has no scheme: write udpin:{where} to listen or udpout:{where} to send there")
    parts = _SCHEME.fullmatch(text)
    if parts is None:
        raise UrlError(f"is not a MAVLink URL: write {_FORMS}")
    scheme, rest = parts[1], parts[3].removesuffix("/")
    if scheme not in set(EndpointKind):
        raise UrlError(_foreign(scheme.lower(), rest))
    kind = EndpointKind(scheme)
    if kind is EndpointKind.STATION:
        raise UrlError("is that of a station, which is a section of its own: write [[station]]")
    return _serial(rest) if kind is EndpointKind.SERIAL else _network(kind, rest)


def parse_line(text: str) -> SerialUrl:
    """Parse ``/dev/ttyUSB0:57600``: the device of a serial network with its baud rate.

    Raises UrlError, which says what to write.
    """
    return _serial(text.removeprefix("serial:"), "")


def _network(kind: EndpointKind, rest: str) -> NetworkUrl:
    if "@" in rest:
        raise UrlError(_TWO_ADDRESSES)
    if "?" in rest or "/" in rest:
        raise UrlError(f"has more than host and port: write {kind}:HOST:PORT alone")
    if rest.isascii() and (port := rest.lstrip(":")).isdigit():
        raise UrlError(f"names no host: write {kind}:127.0.0.1:{port}, which only this machine reaches")
    listening = kind in _LISTENING
    try:
        address = parse_address(rest, allow_names=not listening)
    except AddressError as error:
        raise UrlError(f"after {kind}: the address {error}") from None
    if address.is_wildcard and not listening:
        raise UrlError(f"needs one machine to send to: write {kind}:127.0.0.1:{address.port} for this one")
    return NetworkUrl(kind, address)


def _serial(rest: str, scheme: str = "serial:") -> SerialUrl:
    """``scheme``: what the user has to write before the device."""
    # From the right: names under /dev/serial/by-path have colons in them.
    device, _, baud_text = rest.rpartition(":")
    if not _DEVICE.fullmatch(device) or not (baud_text.isascii() and baud_text.isdigit() and len(baud_text) <= 8):
        raise UrlError(f"needs a device and a baud rate: write {scheme}/dev/ttyACM0:57600 with yours")
    baud = int(baud_text)
    if not 300 <= baud <= _MAX_BAUD:
        raise UrlError(f"has an impossible baud rate: write one from 300 to {_MAX_BAUD}, such as 57600")
    return SerialUrl(device, baud)


def _foreign(scheme: str, rest: str) -> str:
    """The message for a spelling of other software, or an unknown one."""
    if scheme in set(EndpointKind):
        return f"schemes are lower-case: write {scheme}:{_shown(rest)}"
    if "@" in rest:
        return _TWO_ADDRESSES
    if scheme == "udp":
        where = _shown(rest.lstrip(":"))
        return (
            "udp: listens in some software and sends in other:"
            f" write udpin:{where} to listen there or udpout:{where} to send there"
        )
    return f"has no known scheme: write {_FORMS}"


def _shown(rest: str) -> str:
    """The rest of a URL if it is plain; otherwise a placeholder."""
    return rest if re.fullmatch(r"[\[\]A-Za-z0-9.:/_-]{1,80}", rest) else "HOST:PORT"
