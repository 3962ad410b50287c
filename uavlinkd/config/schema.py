"""The keys of a configuration file, with their ranges and defaults: one class for each section, by its name.

README.md explains each key. The kinds of values come first, each with the check of a single value. Checks of several
values are in :mod:`uavlinkd.config.checks`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic_core import CoreSchema

from uavlinkd.authority.certificates import LAST_SERIAL, parse_bulletin, parse_certificate
from uavlinkd.authority.certificates import NAME as MEMBER_NAME
from uavlinkd.config.keys import decode_key, is_canonical_public_key
from uavlinkd.config.model import SERIAL, HttpsServer, PeerAddress
from uavlinkd.config.section import (
    ANYTHING,
    BOOLEAN,
    Section,
    checked,
    choice,
    each,
    integer,
    key,
    number,
    parsed,
)
from uavlinkd.io.url import EndpointUrl, SerialUrl, parse_line, parse_url
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import AuthorityKey, is_usable_public_key
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519, Suite
from uavlinkd.system.addresses import Address, AddressError, parse_address, parse_place
from uavlinkd.system.base64_text import from_base64

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_INTERFACE = re.compile(r"[^\s/:]{1,15}")  # as dev_valid_name() of Linux
# A complete or nearly complete key in base64 or hex: no message repeats it.
_LIKE_A_KEY = re.compile(r"[A-Za-z0-9+/_-]{40,}={0,2}")
_HTTPS = '{ listen = "0.0.0.0:443", certificate = "tls.crt", key = "tls.key" }'
ENROLL_AGAIN = "run `uavlinkd enroll --finish` again with the line of `uavlinkd fleet sign`"
LEAST_BUDGET = 1000
_LEAST_AIR = 1000
_EGRESS = EgressSettings()


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
        decoded = decode_key(_text(value))
    except ValueError as error:
        raise ValueError(f"{error}: write what `uavlinkd pubkey` prints there") from None
    if not is_usable_public_key(decoded):
        raise ValueError(
            "is a point of low order, with which everyone knows the shared secret:"
            " write what `uavlinkd pubkey` prints there"
        )
    if not is_canonical_public_key(decoded):
        raise ValueError(
            "is not a public key of X25519, but perhaps a private key, which must stay secret:"
            " write what `uavlinkd pubkey` prints there"
        )
    return decoded


def _suite(value: Any) -> Suite:
    if isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    text = _text(value).strip().lower()
    if (suite := SUITES_BY_NAME.get(text)) and text == value:
        return suite
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
        address = parse_place(_text(text))
    except AddressError as error:
        if network or {".", ":"} & set(text):
            raise
        raise ValueError(
            f'{error}. The other end of a serial network is {{ network = "sik" }}, with its name'
        ) from None
    if address.is_wildcard:
        raise ValueError('is every address of this machine: write the peer\'s own, such as "10.13.0.2:5790"')
    if address.resource and network:
        raise ValueError("has the URL of a relay with a network: write the URL alone, it uses any")
    return PeerAddress(address, network)


def _https(value: Any) -> HttpsServer:
    files = ("certificate", "key")
    if not isinstance(value, dict) or not {"listen"} <= set(value) <= {"listen", *files}:
        raise ValueError(f"has keys of its own: write {_HTTPS}")
    names: dict[str, Path] = {}
    part = "listen"
    try:
        listen = parse_address(_text(value["listen"]), allow_names=False)
        for part in set(files) & set(value):
            names[part] = Path(_file_name(value[part]))
    except ValueError as error:
        raise ValueError(f"{part} {error}") from None
    if len(names) < len(files):
        raise ValueError(
            "needs a certificate and its key: a web server can no longer stand before the relay. Give it another port"
            f" or address: write {_HTTPS}"
        )
    return HttpsServer(listen, **names)


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


def _member_name(value: Any) -> str:
    if not MEMBER_NAME.fullmatch(_text(value)):
        raise ValueError("is not the name of a member: names have 1 to 21 of a-z, 0-9 and -")
    return str(value)


def _signed(parse: Callable[[bytes], object], what: str) -> CoreSchema:
    """A value of the line that an authority prints, in base64. Its signature: :mod:`uavlinkd.config.fleet_rules`."""

    def check(value: Any) -> object:
        text = _text(value)
        with suppress(ValueError, Drop):
            if (result := parse(from_base64(text))) is not None:
                return result
        raise ValueError(f"is not {what}, or was cut: {ENROLL_AGAIN}")

    return parsed(check)


def _certificate(data: bytes) -> HeldCertificate:
    from uavlinkd.authority.trust import HeldCertificate  # noqa: PLC0415  only if configured

    return HeldCertificate(parse_certificate(data), data)


NAME: Final = parsed(_name)
FILE_NAME: Final = parsed(_file_name)
PUBLIC_KEY: Final = parsed(_public_key)
PEER_ADDRESSES: Final = checked(each(parsed(_peer_address)), _addresses)
BUDGET: Final = checked(integer(0, 10**9), _budget)
CERTIFICATE: Final = _signed(_certificate, "a certificate")
FRAME_ROLE: Final = choice("vehicle", "operator", "observer")


def _seconds(default: float, least: float, most: float) -> Any:
    return key(number(least, most), default)


_SIGNED = '"…", which `uavlinkd enroll --finish` writes'


class LinkSection(Section):
    """``[link]``, and the same keys in ``[[peer]]``: how to communicate with peers."""

    suites: list[Suite] = key(checked(each(parsed(_suite)), _suites), [X25519], '["x25519"]')
    confidential: bool = key(BOOLEAN, False)
    tag_bits: int = key(choice(64, 96, 128), 128)
    max_envelope_bytes: int = key(integer(c.MIN_ENVELOPE_LIMIT, c.MAX_ENVELOPE_LIMIT), c.DEFAULT_ENVELOPE_LIMIT)

    keepalive_s: float = _seconds(c.KEEPALIVE_S, 0.1, 3600)
    lost_after_s: float = _seconds(c.LOST_AFTER_S, 0.2, 1200)
    retry_max_s: float = _seconds(c.RETRY_MAX_S, 0.05, 60)
    rekey_after_s: float = _seconds(c.REKEY_AFTER_S, 1, 3600)
    reject_after_s: float = _seconds(c.REJECT_AFTER_S, 1, 7200)
    probe_interval_s: float = _seconds(c.PROBE_INTERVAL_S, 0.1, 3600)

    budget_bits_s: int = key(BUDGET, _EGRESS.budget_bits_s)
    coalesce_s: float = _seconds(_EGRESS.coalesce_s, 0, 0.5)
    max_age_s: float = _seconds(_EGRESS.max_age_s, 0.1, 60)
    redundancy: str = key(choice("critical", "all", "none"), "critical")
    idle_probe_s: float = _seconds(c.PROBE_IDLE_S, 0, 3600)


class NetworkSection(Section):
    name: str = key(NAME, example='"lte"')
    interface: str | None = key(parsed(_interface), None, '"wwan0"')
    address: str | None = key(parsed(_own_address), None, '"10.0.0.5"')
    serial: SerialUrl | None = key(parsed(lambda value: parse_line(_text(value))), None, '"/dev/ttyUSB0:57600"')
    air_bits_s: int | None = key(integer(_LEAST_AIR, 10_000_000), None, "24000")
    metered: bool = key(BOOLEAN, False)
    budget_bits_s: int = key(BUDGET, 0)


class PolicySection(Section):
    """The keys in ``[[peer]]`` and ``[[endpoint]]`` that limit messages.

    :func:`uavlinkd.mavlink.policy.settings.read_settings` checks them together.
    """

    role: Any = key(ANYTHING, None, '"swarm-member"')
    system_ids: Any = key(ANYTHING, None, "[2]")
    allow_in: Any = key(ANYTHING, None, '["heartbeat", "telemetry"]')
    allow_out: Any = key(ANYTHING, None, '["heartbeat", "telemetry"]')
    rate_in: Any = key(ANYTHING, None, "{ ATTITUDE = 10 }")
    rate_out: Any = key(ANYTHING, None, "{ ATTITUDE = 10 }")
    mavlink1: Any = key(ANYTHING, None, "false")
    ground_station: Any = key(ANYTHING, None, "false")


class KeySection(Section):
    """The keys in ``[[peer]]``, ``[[relay]]`` and ``[[member]]`` that say who another daemon is."""

    name: str = key(NAME, example='"drone1"')
    public_key: bytes = key(PUBLIC_KEY, example='"…", what `uavlinkd pubkey` prints there')
    psk_file: str | None = key(FILE_NAME, None, '"drone0-drone1.psk"')


class PeerSection(LinkSection, PolicySection, KeySection):
    addresses: list[PeerAddress] = key(PEER_ADDRESSES, [], '["10.13.0.2:5790"]')
    relays: list[str] | None = key(each(NAME), None, "[]")


class RelaySection(KeySection):
    addresses: list[PeerAddress] = key(PEER_ADDRESSES, [], '["relay.example.org:5790"]')


class MemberSection(KeySection):
    max_peers: int = key(integer(1, 4000), 256)
    bits_s: int = key(integer(LEAST_BUDGET, 10**10), 20_000_000, "20_000_000")


class RelayServerSection(Section):
    https: HttpsServer | None = key(parsed(_https), None, _HTTPS)
    bits_s: int = key(integer(LEAST_BUDGET, 10**10), 10**10, "100_000_000")
    member_bits_s: int = key(integer(LEAST_BUDGET, 10**10), 20_000_000, "20_000_000")


class FleetSection(Section):
    authority: AuthorityKey = key(_signed(AuthorityKey, "the public key of an authority"), example=_SIGNED)
    certificate: HeldCertificate = key(CERTIFICATE, example=_SIGNED)
    bulletin: bytes = key(_signed(lambda data: data if parse_bulletin(data) else None, "a bulletin"), example=_SIGNED)
    call: list[str] | None = key(each(FRAME_ROLE), None, '["operator"]')
    operator: str = key(choice("certificate", "pinned"), "certificate")
    require_bulletin: int = key(integer(0, LAST_SERIAL), 0)
    deny: list[str] = key(each(parsed(_member_name)), [], '["v3"]')


class ContactSection(Section):
    public_key: bytes = key(PUBLIC_KEY, example=_SIGNED)
    certificate: HeldCertificate = key(CERTIFICATE, example=_SIGNED)
    addresses: list[PeerAddress] = key(PEER_ADDRESSES, [], '["relay.example.org:5790"]')
    relays: bool = key(BOOLEAN, False)


class FleetRoleSection(PolicySection):
    """``[[fleet_role]]``: what the members with a role may send here, instead of the usual policy."""

    name: str = key(FRAME_ROLE, example='"operator"')


class EndpointSection(PolicySection):
    name: str = key(NAME, example='"autopilot"')
    url: EndpointUrl = key(parsed(lambda value: parse_url(_text(value))), example='"udpin:127.0.0.1:14550"')
    radio_status: bool = key(BOOLEAN, False)
    status_text: bool = key(BOOLEAN, False)


class RoutingSection(Section):
    relay: bool = key(BOOLEAN, False)


class LogSection(Section):
    level: str = key(choice("debug", "info", "warning", "error"), "info")
    format: str = key(choice("auto", "console", "json"), "auto")


class FileSection(Section):
    """The top of the file. Its sections are read one by one, so that each problem names its section."""

    name: str = key(NAME, example='"drone0"')
    private_key_file: str = key(FILE_NAME, example='"drone0.key"')
    listen: list[Address] = key(
        each(parsed(lambda value: parse_address(_text(value), allow_names=False))), [], '["0.0.0.0:5790"]'
    )
    control_socket: str | None = key(FILE_NAME, None, '"drone0.sock"')


SINGLE: dict[str, type[Section]] = {
    "link": LinkSection,
    "log": LogSection,
    "routing": RoutingSection,
    "relay_server": RelayServerSection,
    "fleet": FleetSection,
}
"""The sections that a file has once, such as ``[link]``."""
REPEATED: dict[str, type[Section]] = {
    "network": NetworkSection,
    "endpoint": EndpointSection,
    "peer": PeerSection,
    "member": MemberSection,
    "relay": RelaySection,
    "contact": ContactSection,
    "fleet_role": FleetRoleSection,
}
"""The sections that a file may have several times, such as ``[[peer]]``."""
