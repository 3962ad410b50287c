"""Problems of a configuration file, for the person who wrote it.

A message names the file, the key, the problem and what to write instead. It never repeats a value: a value in
the wrong place may be a secret.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic_core import ErrorDetails

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config import schema
from uavlinkd.config.model import ConfigError, Problem
from uavlinkd.config.section import Key, Section, read
from uavlinkd.mavlink.policy.settings import INSTEAD_OF_DENIAL
from uavlinkd.protocol.crypto import Secret, x25519_public_key

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate


class Values(NamedTuple):
    """The valid values of one section by key, and the keys whose values are invalid."""

    section: str  # `peer[1]`; empty for the top of the file
    valid: dict[str, Any]
    invalid: frozenset[str]

    @property
    def kind(self) -> str:
        """``peer`` of ``peer[1]``."""
        return self.section.partition("[")[0]

    def get(self, key: str, default: Any = None) -> Any:
        return self.valid.get(key, default)

    def at(self, key: str = "") -> str:
        """The place of a key, or of the section: ``peer[1].public_key (drone1)``."""
        path = ".".join(part for part in (self.section, key) if part)
        name = self.valid.get("name") if self.section else None
        return f"{path} ({name})" if name else path

    def lacks(self, key: str) -> bool:
        """Whether the key is not written, or its value is empty. False if the value is invalid."""
        return not self.valid.get(key) and key not in self.invalid


@dataclass(frozen=True, slots=True)
class Sections:
    """The values of one file in ``folder``. ``secrets``: content of its key files, by the place of the key.

    ``written``: the sections and keys at the top of the file, also those without a valid value.
    """

    folder: Path
    written: frozenset[str]
    top: Values
    link: Values
    log: Values
    routing: Values
    relay_server: Values
    fleet: Values
    networks: list[Values]
    endpoints: list[Values]
    peers: list[Values]
    members: list[Values]
    relays: list[Values]
    contacts: list[Values]  # each has the name in its certificate
    fleet_roles: list[Values]
    secrets: dict[str, Secret] = field(default_factory=dict)

    @property
    def others(self) -> list[Values]:
        return [*self.peers, *self.members, *self.relays, *self.contacts]

    @property
    def has_fleet(self) -> bool:
        return "fleet" in self.written

    @property
    def is_relay(self) -> bool:
        """Whether this daemon relays for others."""
        is_member_relay = role_of(self.fleet) == MemberRole.RELAY or "relay_server" in self.written
        return bool(self.members) or (self.has_fleet and is_member_relay)

    @property
    def used_relays(self) -> list[Values]:
        """The relays, and the contacts that this daemon uses as such.

        A relay needs none. A station that relays uses no other station: two daemons cannot be relays of each other.
        """
        if role_of(self.fleet) == MemberRole.RELAY:
            return self.relays
        may_be_station = not self.is_relay
        contacts = (
            contact
            for contact in self.contacts
            if role_of(contact) == MemberRole.RELAY or (may_be_station and contact.get("relays"))
        )
        return [*self.relays, *contacts]

    def secret(self, section: Values, key: str) -> Secret | None:
        """The content of the key file that a section names under a key."""
        return self.secrets.get(section.at(key))

    @property
    def own_key(self) -> bytes | None:
        secret = self.secret(self.top, "private_key_file")
        return None if secret is None else x25519_public_key(secret.reveal())


def role_of(section: Values) -> MemberRole | None:
    """The role in the certificate of ``[fleet]`` or a contact, if that is valid."""
    held: HeldCertificate | None = section.get("certificate")
    return None if held is None else held.certificate.role


Found = Iterator[tuple[str, str]]
"""The problems that a rule finds: the place of a key, what is wrong there and what to do."""


def unique(sections: Iterable[Values], key: str, message: str) -> Found:
    """No two sections have the same value of a key. ``message`` says what to do, with the place of the ``other``."""
    first: dict[object, Values] = {}
    for section in sections:
        if (value := section.get(key)) is not None and (other := first.setdefault(value, section)) is not section:
            yield section.at(key), "is " + message.format(other=other.at())


class Problems:
    """The problems of one file, in the order in which they are found."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._found: list[Problem] = []

    def add(self, key: str, message: str) -> None:
        self._found.append(Problem(self._file, key, message))

    def raise_any(self) -> None:
        if self._found:
            raise ConfigError(tuple(self._found))

    def read(self, model: type[Section], table: Mapping[str, Any], section: str) -> Values:
        valid, problems = read(model, table)
        values = Values(section, valid, frozenset(str(details["loc"][0]) for details in problems))
        for details in problems:
            self.add(values.at(_path(details["loc"])), _message(details, model))
        return values


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,32}")


def _path(location: tuple[int | str, ...]) -> str:
    """``suites[0]``. Only a plain word is repeated: another key may be a secret, or control a terminal."""
    return "".join(
        f"[{part}]" if isinstance(part, int) else part if _BARE_KEY.fullmatch(part) else "…" for part in location
    )


_MESSAGES = {
    "missing": "is missing: write {key} = {example}",
    "bool_type": "must be true or false, without quotes: write {key} = {example}",
    "int_type": "must be a whole number, without quotes: write {key} = {example}",
    "float_type": "must be a number, without quotes: write {key} = {example}",
    "finite_number": "must be a finite number: write {key} = {example}",
    "greater_than_equal": "is too small: write {limit} or more",
    "less_than_equal": "is too large: write {limit} or less",
    "literal_error": "must be {expected}",
    "list_type": "must be a list: write {key} = {example}",
}
"""The problem and its remedy, for each kind of error that the schema raises."""


def _message(details: ErrorDetails, model: type[Section]) -> str:
    key, context = str(details["loc"][0]), details.get("ctx", {})
    if details["type"] == "extra_forbidden":
        return unknown_key(key, model)
    if details["type"] == "value_error":
        return str(context["error"])
    limit = context.get("ge", context.get("le"))
    return _MESSAGES.get(details["type"], "cannot be used: write {key} = {example}").format(
        key=key,
        example=_example(model.keys[key]),
        limit=f"{limit:g}" if isinstance(limit, float) else limit,
        expected=context.get("expected"),
    )


def _example(key: Key) -> str:
    """A value as it is written in TOML. A person who writes a boolean wants another value than the default."""
    if key.example:
        return key.example
    if isinstance(key.default, bool):
        return str(not key.default).lower()
    return f"{key.default:g}" if isinstance(key.default, int | float) else f'"{key.default}"'


def example_of(key: str) -> str | None:
    """A value of a key as it is written in TOML; None if no section has the key."""
    keys = (model.keys.get(key) for model in _SECTIONS.values())
    return next((_example(one) for one in keys if one is not None), None)


_SECTIONS: dict[str, type[Section]] = {
    "at the top, before the first [section]": schema.FileSection,
    "in [link] or in a [[peer]]": schema.LinkSection,
    "in a [[peer]] or an [[endpoint]]": schema.PolicySection,
    **{f"in [[{key}]]": model for key, model in schema.REPEATED.items()},
    **{f"in [{key}]": model for key, model in schema.SINGLE.items()},
}

_UDP, _SERIAL = 'url = "udpin:127.0.0.1:14550"', 'url = "serial:/dev/ttyACM0:57600"'
_IN_A_FILE = "the name of a file that holds the key: this file never contains a key"
_OTHERS_CALL_IT: dict[type[Section], dict[str, str]] = {
    Section: {
        "private_key": f"private_key_file, {_IN_A_FILE}",
        **dict.fromkeys(("psk", "preshared_key"), f"psk_file, {_IN_A_FILE}"),
        "listen_port": 'listen, with an address: listen = ["0.0.0.0:5790"]',
        "mtu": "max_envelope_bytes, the size of the UDP payload",
        "encryption": "confidential = true",
    },
    schema.FileSection: {"log_level": '[log] at the end of the file, and below it level = "info"'},
    schema.PeerSection: {
        **dict.fromkeys(("address", "endpoint"), 'addresses, a list: addresses = ["10.13.0.2:5790"]'),
        "interface": 'addresses = [{ address = "10.13.0.2:5790", network = "mesh" }], and a [[network]] "mesh" with'
        " this interface",
        "allowed_ips": "role and system_ids: they say what the peer may do",
    },
    schema.RelaySection: {"address": 'addresses, a list: addresses = ["relay.example.org:5790"]'},
    schema.EndpointSection: {
        **dict.fromkeys(("address", "port"), _UDP),
        **dict.fromkeys(("device", "baud"), _SERIAL),
    },
}
"""Names that WireGuard and common usage have for keys of any section or of one, where the most similar is another."""


_REMOVED = {
    **dict.fromkeys(
        ("previous_public_key", "previous_private_key_file"),
        "to change a key, write the new public key into the other ends' files, restart the daemon whose key it is,"
        " and reload the others at the same time; in a fleet, `uavlinkd enroll NAME` there makes one",
    ),
    **dict.fromkeys(("deny_in", "deny_out"), INSTEAD_OF_DENIAL),
    "successor": "delete the line: nothing used it",
    "recording": "delete [recording]: ground stations record, and so does `mavproxy.py --daemon` beside the daemon",
    "mac_key_bits": "delete the line: every HMAC key has 256 bits, and a longer one was no stronger",
    **dict.fromkeys(
        ("datagrams_s", "member_datagrams_s"),
        "delete the line: a relay passes one datagram for each 10,000 bits of bits_s or member_bits_s",
    ),
    "member_max_peers": "delete the line: each member of a fleet may ask a relay for all others",
    "metrics": "delete [metrics]; `uavlinkd web` serves http://127.0.0.1:8790/metrics",
}
"""Keys and sections that files of earlier versions may have."""


def unknown_key(key: str, model: type[Section]) -> str:
    if key in _REMOVED:
        return f"was removed: {_REMOVED[key]}"
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[ -]", "_", key).lower()
    for section in (model, Section):
        if remedy := _OTHERS_CALL_IT.get(section, {}).get(plain):
            return f"is not known here: write {remedy}"
    if key in _SECTION_NAMES:
        return f"does not belong here: write {_SECTION_NAMES[key]}, a section of its own"
    for where, other in _SECTIONS.items():
        if key in other.keys and key not in model.keys:
            return f"does not belong here: write it {where}"
    known = [*model.keys, *(_SECTION_NAMES if model is schema.FileSection else ())]
    if close := get_close_matches(plain, known, n=1, cutoff=0.7):
        return f"is not known: did you mean {_SECTION_NAMES.get(close[0], close[0])}?"
    return f"is not known here: the keys are {', '.join(known)}"


_SECTION_NAMES = {key: f"[{key}]" for key in schema.SINGLE} | {key: f"[[{key}]]" for key in schema.REPEATED}
