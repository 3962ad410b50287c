"""The keys of a configuration file, with their ranges and defaults: one table for each section, by its name.

README.md explains each key. The kinds of values come first, each with the check of a single value. Checks of several
values are in :mod:`uavlinkd.config.checks`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from ipaddress import IPv6Address, ip_address, ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from uavlinkd.authority.certificates import LAST_SERIAL, parse_bulletin, parse_certificate
from uavlinkd.config.keys import decode_key, is_canonical_public_key
from uavlinkd.config.model import LINK_ID, SERIAL, HttpsServer, PeerAddress
from uavlinkd.config.section import Choice, Key, Keys, Kind, Number, anything, boolean, each, integer, text
from uavlinkd.io.url import parse_line, parse_url
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.policy.settings import KEYS as POLICY_KEYS
from uavlinkd.mavlink.signing.signature import FIRST_LINK_ID
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import AuthorityKey, is_usable_public_key
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519
from uavlinkd.system.addresses import Address, AddressError, parse_address, parse_place
from uavlinkd.system.base64_text import from_base64

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
# A complete or nearly complete key in base64 or hex: no message repeats it.
_LIKE_A_KEY = re.compile(r"[A-Za-z0-9+/_-]{40,}={0,2}")
_HTTPS = '{ listen = "0.0.0.0:443", certificate = "tls.crt", key = "tls.key" }'
ENROLL_AGAIN = "run `uavlinkd enroll --finish` again with the line of `uavlinkd fleet sign`"
LEAST_BITS_S = 1000
MEMBER_BITS_S = 20_000_000
_EGRESS = EgressSettings()


def _name(value: Any) -> str:
    # Logs, metrics and file names contain names, so a name has no character with a special meaning there.
    if not _NAME.fullmatch(text(value)):
        raise ValueError("must be a name of up to 63 letters, digits, dots, hyphens and underscores")
    return str(value)


def _file_name(value: Any) -> str:
    name = text(value)
    if _LIKE_A_KEY.fullmatch(name.strip()):
        raise ValueError("is a key, not the name of a file: write the key to a file of mode 0600 and name that file")
    if not name or not name.isprintable():
        raise ValueError('must name a file: write a name such as "drone0.key"')
    return name


def _public_key(value: Any) -> bytes:
    remedy = "write what `uavlinkd pubkey` prints there"
    try:
        decoded = decode_key(text(value))
    except ValueError as error:
        raise ValueError(f"{error}: {remedy}") from None
    if not is_usable_public_key(decoded):
        raise ValueError(f"is a point of low order, with which everyone knows the shared secret: {remedy}")
    if not is_canonical_public_key(decoded):
        problem = "is not a public key of X25519, but perhaps a private key, which must stay secret"
        raise ValueError(f"{problem}: {remedy}")
    return decoded


def _budget(value: Any) -> float:
    bits_s = integer(0, 10**9)(value)
    if 0 < bits_s < LEAST_BITS_S:
        raise ValueError(f"is too small: write {LEAST_BITS_S} or more, in bits a second, or 0 for no limit")
    return bits_s


def _peer_address(value: Any) -> PeerAddress:
    place, network = value, ""
    if isinstance(value, dict):
        if set(value) == {"network"}:
            return PeerAddress(SERIAL, _name(value["network"]))
        if set(value) != {"address", "network"}:
            raise ValueError(
                'must have two keys: write { address = "10.13.0.2:5790", network = "mesh" }, or { network = "sik" }'
                " for a serial network"
            )
        place, network = value["address"], _name(value["network"])
    try:
        address = parse_place(text(place))
    except AddressError as error:
        if network or {".", ":"} & set(place):
            raise
        remedy = 'The other end of a serial network is { network = "sik" }, with its name'
        raise ValueError(f"{error}. {remedy}") from None
    if address.is_wildcard:
        raise ValueError('is every address of this machine: write the peer\'s own, such as "10.13.0.2:5790"')
    if address.resource and network:
        raise ValueError("has the URL of a relay with a network: write the URL alone, it uses any")
    return PeerAddress(address, network)


def _listening(value: Any) -> Address:
    return parse_address(text(value), allow_names=False)


def _https(value: Any) -> HttpsServer:
    kinds: dict[str, Kind] = {"listen": _listening, **dict.fromkeys(("certificate", "key"), _file_name)}
    if not isinstance(value, dict) or set(value) != set(kinds):
        problem = "needs listen, certificate and key: a web server can no longer stand before the relay"
        raise ValueError(f"{problem}. Give it another port or address: write {_HTTPS}")
    parts = dict[str, Any]()
    for part, written in value.items():
        try:
            parts[part] = kinds[part](written)
        except ValueError as error:
            raise ValueError(f"{part} {error}") from None
    return HttpsServer(parts["listen"], Path(parts["certificate"]), Path(parts["key"]))


def _own_address(value: Any) -> str:
    with suppress(ValueError):
        ip = ip_address(text(value))
        has_other_form = isinstance(ip, IPv6Address) and (
            ip.ipv4_mapped or (ip.is_link_local and ip.scope_id is None)
        )
        if not (ip.is_unspecified or ip.is_multicast or str(ip) == "255.255.255.255" or has_other_form):
            return str(ip)
    raise ValueError(
        'is not one address of this machine: write one, without a port, such as "10.0.0.5" or "fe80::5%wlan0", or'
        ' write interface = "wlan0" instead'
    )


def _signed(parse: Callable[[bytes], object], what: str) -> Kind:
    """A value of the line that an authority prints, in base64. Its signature: :mod:`uavlinkd.config.fleet_rules`."""

    def check(value: Any) -> object:
        encoded = text(value)
        with suppress(ValueError, Drop):
            if (result := parse(from_base64(encoded))) is not None:
                return result
        raise ValueError(f"is not {what}, or was cut: {ENROLL_AGAIN}")

    return check


def _certificate(data: bytes) -> HeldCertificate:
    from uavlinkd.authority.trust import HeldCertificate  # noqa: PLC0415  only if configured

    return HeldCertificate(parse_certificate(data), data)


def _inner_network(value: Any) -> str:
    with suppress(ValueError):
        network = ip_network(text(value))
        if network.is_private and 4 <= network.num_addresses <= 65536:
            return str(network)
    raise ValueError(
        "is not a private network of 4 to 65536 addresses: write one that your stations do not use otherwise, such as"
        ' "10.66.0.0/24"'
    )


def _inner_address(value: Any) -> str:
    with suppress(ValueError):
        return str(ip_address(text(value)))
    raise ValueError('is not an address inside the tunnels: write one such as "10.66.0.2"')


def _seconds(default: float, least: float, most: float) -> Key:
    return Key(Number(least, most), default)


_BITS_S: Final = integer(LEAST_BITS_S, 10**10)
_SIGNED: Final = '"…", which `uavlinkd enroll --finish` writes'
_CERTIFICATE: Final = Key(_signed(_certificate, "a certificate"), written=_SIGNED)
_FRAME_ROLE: Final = Choice("vehicle", "operator", "observer")

LINK: Final[Keys] = {
    "suites": Key(each(Choice(*SUITES_BY_NAME), least=1), [X25519.name], '["x25519"]'),
    "confidential": Key(boolean, False),
    "tag_bits": Key(Choice(64, 96, 128), 128),
    "max_envelope_bytes": Key(integer(c.MIN_ENVELOPE_LIMIT, c.MAX_ENVELOPE_LIMIT), c.DEFAULT_ENVELOPE_LIMIT),
    "keepalive_s": _seconds(c.KEEPALIVE_S, 0.1, 3600),
    "lost_after_s": _seconds(c.LOST_AFTER_S, 0.2, 1200),
    "retry_max_s": _seconds(c.RETRY_MAX_S, 0.05, 60),
    "rekey_after_s": _seconds(c.REKEY_AFTER_S, 1, 3600),
    "reject_after_s": _seconds(c.REJECT_AFTER_S, 1, 7200),
    "budget_bits_s": Key(_budget, _EGRESS.budget_bits_s),
    "coalesce_s": _seconds(_EGRESS.coalesce_s, 0, 0.5),
    "max_age_s": _seconds(_EGRESS.max_age_s, 0.1, 60),
    "redundancy": Key(Choice("critical", "all", "none"), "critical"),
    "idle_probe_s": _seconds(c.PROBE_IDLE_S, 0, 3600),
}
"""``[link]``, and the same keys in ``[[peer]]``: how to communicate with peers."""
POLICY: Final[Keys] = dict.fromkeys(POLICY_KEYS, Key(anything, None))
"""The keys that limit messages. :func:`uavlinkd.mavlink.policy.settings.read_settings` checks them together."""
_WITH_KEY: Final[Keys] = {
    "name": Key(_name, written='"drone1"'),
    "public_key": Key(_public_key, written='"…", what `uavlinkd pubkey` prints there'),
}
"""The keys that say who another daemon is."""

SINGLE: Final[dict[str, Keys]] = {
    "link": LINK,
    "log": {
        "level": Key(Choice("debug", "info", "warning", "error"), "info"),
        "format": Key(Choice("auto", "console", "json"), "auto"),
    },
    "routing": {"relay": Key(boolean, False)},
    "relay_server": {
        "https": Key(_https, None, _HTTPS),
        "bits_s": Key(_BITS_S, 10**10, "100_000_000"),
        "member_bits_s": Key(_BITS_S, MEMBER_BITS_S, "20_000_000"),
    },
    "stations": {
        "private_key_file": Key(_file_name, written='"stations.key"'),
        "listen": Key(_listening, parse_address("0.0.0.0:51820", allow_names=False), '"0.0.0.0:51820"'),
        "network": Key(_inner_network, "10.66.0.0/24"),
    },
    "fleet": {
        "authority": Key(_signed(AuthorityKey, "the public key of an authority"), written=_SIGNED),
        "certificate": _CERTIFICATE,
        "bulletin": Key(_signed(lambda data: data if parse_bulletin(data) else None, "a bulletin"), written=_SIGNED),
        "call": Key(each(_FRAME_ROLE), None, '["operator"]'),
        "operator": Key(Choice("certificate", "pinned"), "certificate"),
        "require_bulletin": Key(integer(0, LAST_SERIAL), 0),
        "deny": Key(each(_name), [], '["v3"]'),
    },
}
"""The sections that a file has once, such as ``[link]``."""
REPEATED: Final[dict[str, Keys]] = {
    "network": {
        "name": Key(_name, written='"lte"'),
        "interface": Key(_name, None, '"wwan0"'),
        "address": Key(_own_address, None, '"10.0.0.5"'),
        "serial": Key(lambda value: parse_line(text(value)), None, '"/dev/ttyUSB0:57600"'),
        "air_bits_s": Key(integer(LEAST_BITS_S, 10_000_000), None, "24000"),
        "metered": Key(boolean, False),
        "budget_bits_s": Key(_budget, 0),
    },
    "endpoint": {
        "name": Key(_name, written='"autopilot"'),
        "url": Key(lambda value: parse_url(text(value)), written='"udpin:127.0.0.1:14550"'),
        "radio_status": Key(boolean, False),
        "status_text": Key(boolean, False),
        "signing_key_file": Key(_file_name, None, '"autopilot.key"'),
        "signing_link_id": Key(integer(FIRST_LINK_ID, 255), LINK_ID),
        **POLICY,
    },
    "peer": {
        **_WITH_KEY,
        "psk_file": Key(_file_name, None, '"drone0-drone1.psk"'),
        "addresses": Key(each(_peer_address), [], '["10.13.0.2:5790"]'),
        "relays": Key(each(_name), None, "[]"),
        **POLICY,
        **LINK,
    },
    "station": {
        "name": Key(_name, written='"tablet"'),
        "public_key": Key(_public_key, written='"…", what `uavlinkd station add` prints'),
        "address": Key(_inner_address, written='"10.66.0.2"'),
        "ports": Key(each(integer(1, 65535), least=1), [14550]),
        **POLICY,
    },
    "member": _WITH_KEY,
    "relay": {**_WITH_KEY, "addresses": Key(each(_peer_address), [], '["relay.example.org:5790"]')},
    "contact": {
        "public_key": Key(_public_key, written=_SIGNED),
        "certificate": _CERTIFICATE,
        "addresses": Key(each(_peer_address), [], '["relay.example.org:5790"]'),
        "relays": Key(boolean, False),
    },
    "fleet_role": {"name": Key(_FRAME_ROLE, written='"operator"'), **POLICY},
}
"""The sections that a file may have several times, such as ``[[peer]]``."""
TOP: Final[Keys] = {
    "name": Key(_name, written='"drone0"'),
    "private_key_file": Key(_file_name, written='"drone0.key"'),
    "listen": Key(each(_listening), [], '["0.0.0.0:5790"]'),
    "control_socket": Key(_file_name, None, '"drone0.sock"'),
}
"""The keys at the top of the file, before its sections."""
SECTIONS: Final[dict[str, Keys]] = {**SINGLE, **REPEATED}
TITLES: Final = {**{key: f"[{key}]" for key in SINGLE}, **{key: f"[[{key}]]" for key in REPEATED}}
"""The sections as they are written in a file."""
