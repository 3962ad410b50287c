"""The kinds of values in a configuration file, each with the check of a single value."""

from __future__ import annotations

import re
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Annotated, Any

from pydantic import AfterValidator, PlainValidator

from uavlinkd.config.keys import decode_key, is_canonical_public_key
from uavlinkd.config.model import SERIAL, PeerAddress
from uavlinkd.core.crypto import is_usable_public_key
from uavlinkd.core.suites import SUITES_BY_NAME, Suite
from uavlinkd.endpoints.url import EndpointUrl, SerialUrl, parse_line, parse_url
from uavlinkd.system.addresses import Address, AddressError, parse_address

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_INTERFACE = re.compile(r"[^\s/:]{1,15}")  # as dev_valid_name() of Linux
# A complete or nearly complete key in base64 or hex: no message repeats it.
_LIKE_A_KEY = re.compile(r"[A-Za-z0-9+/_-]{40,}={0,2}")
_SMALL_GROUP = re.compile(r"(?:modp|ffdhe?|dhe?)?[-_ ]?(?:512|768|1024)")
LEAST_BUDGET = 1000


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("must be text in quotes")
    return value


def _name(value: Any) -> str:
    # Logs, metrics and file names contain names, so a name has no character with a special meaning there.
    if not _NAME.fullmatch(_text(value)):
        raise ValueError("must be a name of up to 63 letters, digits, dots, hyphens and underscores")
    return str(value)


def _file_name(value: Any) -> str:
    text = _text(value)
    if _LIKE_A_KEY.fullmatch(text.strip()):
        raise ValueError("is a key, not the name of a file: write the key to a file of mode 0600 and name that file")
    if not text or not text.isprintable():
        raise ValueError('must name a file: write a name such as "drone0.key"')
    return text


def _public_key(value: Any) -> bytes:
    try:
        key = decode_key(_text(value))
    except ValueError as error:
        raise ValueError(f"{error}: write what `uavlinkd pubkey` prints there") from None
    if not is_usable_public_key(key):
        raise ValueError(
            "is a point of low order, with which everyone knows the shared secret:"
            " write what `uavlinkd pubkey` prints there"
        )
    if not is_canonical_public_key(key):
        raise ValueError(
            "is not a public key of X25519, but perhaps a private key, which must stay secret:"
            " write what `uavlinkd pubkey` prints there"
        )
    return key


def _suite(value: Any) -> Suite:
    if isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    text = _text(value).strip().lower()
    if (suite := SUITES_BY_NAME.get(text)) and text == value:
        return suite
    if _SMALL_GROUP.fullmatch(text):
        raise ValueError(
            "is a Diffie-Hellman group of 1024 bits or less: one long computation in advance, which a state"
            ' can afford, breaks every exchange in it (Logjam, 2015); write "x25519", or "ffdhe2048" and above'
        )
    names = ", ".join(SUITES_BY_NAME)
    raise ValueError(f"is not a suite: write one of {names}")


def _suites(values: list[Suite]) -> list[Suite]:
    if not values:
        raise ValueError('must name a suite: write ["x25519"]')
    if len(set(values)) != len(values):
        raise ValueError("names a suite twice: write each once, first the one to offer")
    return values


def _addresses(values: list[PeerAddress]) -> list[PeerAddress]:
    everywhere = {value.address for value in values if not value.network}
    if len(set(values)) != len(values):
        raise ValueError("names an address twice: write each once")
    if any(value.network and value.address in everywhere for value in values):
        raise ValueError("names an address with a network and without, which stands for every network: write one")
    return values


def _budget(value: int) -> int:
    if 0 < value < LEAST_BUDGET:
        raise ValueError(f"is too small: write {LEAST_BUDGET} or more, in bits a second, or 0 for no limit")
    return value


def _peer_address(value: Any) -> PeerAddress:
    text, network = value, ""
    if isinstance(value, dict):
        if set(value) == {"network"}:
            return PeerAddress(SERIAL, _name(value["network"]))
        if set(value) != {"address", "network"}:
            raise ValueError(
                'must have two keys: write { address = "10.13.0.2:5790", network = "mesh" }, or { network = "sik" }'
                " for a serial network"
            )
        text, network = value["address"], _name(value["network"])
    try:
        address = parse_address(_text(text), allow_names=True)
    except AddressError as error:
        if network or {".", ":"} & set(text):
            raise
        raise ValueError(
            f'{error}. The other end of a serial network is {{ network = "sik" }}, with its name'
        ) from None
    if address.is_wildcard:
        raise ValueError('is every address of this machine: write the peer\'s own, such as "10.13.0.2:5790"')
    return PeerAddress(address, network)


def _interface(value: Any) -> str:
    text = _text(value)
    if not _INTERFACE.fullmatch(text) or not text.isprintable() or text in (".", ".."):
        raise ValueError("is not a name of a network interface: write one of those that `ip -brief link` lists")
    return text


def _own_address(value: Any) -> str:
    try:
        ip = ip_address(_text(value))
    except ValueError:
        raise ValueError(
            'is not an IP address: write one of this machine\'s, without a port, such as "10.0.0.5";'
            " the port is that of listen"
        ) from None
    if ip.is_unspecified:
        raise ValueError('is every address of this machine: write one of them, or interface = "wlan0" instead')
    if ip.is_multicast or ip == IPv4Address("255.255.255.255"):
        raise ValueError("is a multicast or broadcast address: write an address of this machine")
    if isinstance(ip, IPv6Address) and ip.ipv4_mapped is not None:
        raise ValueError(f'is an IPv4 address in IPv6 form: write "{ip.ipv4_mapped}"')
    if isinstance(ip, IPv6Address) and ip.is_link_local and ip.scope_id is None:
        raise ValueError(f'is link-local, valid on one interface only: write "{ip}%wlan0" with that interface')
    return str(ip)


Name = Annotated[str, PlainValidator(_name)]
FileName = Annotated[str, PlainValidator(_file_name)]
PublicKey = Annotated[bytes, PlainValidator(_public_key)]
Suites = Annotated[list[Annotated[Suite, PlainValidator(_suite)]], AfterValidator(_suites)]
ListenAddress = Annotated[Address, PlainValidator(lambda value: parse_address(_text(value), allow_names=False))]
PeerAddresses = Annotated[list[Annotated[PeerAddress, PlainValidator(_peer_address)]], AfterValidator(_addresses)]
Interface = Annotated[str, PlainValidator(_interface)]
OwnAddress = Annotated[str, PlainValidator(_own_address)]
SerialLine = Annotated[SerialUrl, PlainValidator(lambda value: parse_line(_text(value)))]
Url = Annotated[EndpointUrl, PlainValidator(lambda value: parse_url(_text(value)))]
Budget = Annotated[int, AfterValidator(_budget)]
