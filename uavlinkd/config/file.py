"""One configuration file: its sections and its problems, for the person who wrote it.

A message names the file, the key, the problem and what to write instead. It never repeats a value: a value in
the wrong place may be a secret.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config.model import ConfigError, PeerAddress, Problem
from uavlinkd.config.schema import POLICY, SECTIONS, SINGLE, TITLES, TOP
from uavlinkd.config.section import Keys, Values, read
from uavlinkd.system.spelling import meant

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate

Found = Iterator[tuple[str, str]]
"""The problems that a rule finds: the place of a key, what is wrong there and what to do."""


class File:
    """The valid values of a file by section, and its problems in the order in which they are found.

    When the key files are read, their content takes the place of their names. Contacts get the names in their
    certificates.
    """

    def __init__(self, path: Path, table: Mapping[str, Any]) -> None:
        self.path = path
        self.folder = path.absolute().parent
        self.own_key: bytes | None = None
        """The public key that belongs to ``private_key_file``, if that could be read."""
        self._problems: list[Problem] = []
        self.top = self._read(TOP, {key: table[key] for key in table if key not in SECTIONS}, "")
        self._sections = {key: self._read_all(key, table[key]) for key in SECTIONS if key in table}

    def __getitem__(self, kind: str) -> list[Values]:
        """The sections of a kind. One that the file has once is written if the list is not empty."""
        return self._sections.get(kind, [])

    def one(self, kind: str) -> Values:
        """The section that a file has once; empty if it is not written."""
        return self[kind][0] if self[kind] else Values(kind, SECTIONS[kind], {})

    def add(self, key: str, message: str) -> None:
        self._problems.append(Problem(str(self.path), key, message))

    def raise_any(self) -> None:
        if self._problems:
            raise ConfigError(tuple(self._problems))

    def _read_all(self, kind: str, value: Any) -> list[Values]:
        if kind in SINGLE:
            if not isinstance(value, dict):
                self.add(kind, f"must be a section: write [{kind}], in single brackets, and its keys below")
            return [self._read(SINGLE[kind], value if isinstance(value, dict) else {}, kind)]
        tables = [table for table in (value if isinstance(value, list) else [value]) if isinstance(table, dict)]
        if kind == "relay" and isinstance(value, bool):
            self.add(kind, "does not belong here: write it in [routing], or [[relay]] for a relay")
        elif tables != value:
            self.add(kind, f"must be a list of sections: write [[{kind}]], in double brackets, for each")
        return [self._read(SECTIONS[kind], table, f"{kind}[{number}]") for number, table in enumerate(tables)]

    def _read(self, keys: Keys, table: Mapping[str, Any], section: str) -> Values:
        values, problems = read(keys, table, section)
        for place, message in problems:
            self.add(values.at(place), message)
        for key in table:
            if key not in keys:
                self.add(values.at(key if _BARE_KEY.fullmatch(key) else "…"), unknown_key(key, values.kind))
        return values

    @property
    def others(self) -> list[Values]:
        """The sections of other daemons with their keys."""
        return [*self["peer"], *self["member"], *self["relay"], *self["contact"]]

    @property
    def is_relay(self) -> bool:
        """Whether this daemon relays for others."""
        is_member_relay = role_of(self.one("fleet")) == MemberRole.RELAY or bool(self["relay_server"])
        return bool(self["member"]) or (bool(self["fleet"]) and is_member_relay)

    @property
    def used_relays(self) -> list[Values]:
        """The relays, and the contacts that this daemon uses as such.

        A relay needs none. A station that relays uses no other station: two daemons cannot be relays of each other.
        """
        if role_of(self.one("fleet")) == MemberRole.RELAY:
            return self["relay"]
        may_be_station = not self.is_relay
        contacts = (
            contact
            for contact in self["contact"]
            if role_of(contact) == MemberRole.RELAY or (may_be_station and contact.get("relays"))
        )
        return [*self["relay"], *contacts]


def role_of(section: Values) -> MemberRole | None:
    """The role in the certificate of ``[fleet]`` or a contact, if that is valid."""
    held: HeldCertificate | None = section.get("certificate")
    return None if held is None else held.certificate.role


def with_same_key(section: Values, others: Iterable[Values]) -> Values | None:
    """The section with the public key of another section: a peer that is a relay or member too."""
    key = section.get("public_key")
    return next((other for other in others if key is not None and other.get("public_key") == key), None)


def over_ip(section: Values) -> list[PeerAddress]:
    """The addresses of a section, without serial networks."""
    return [written for written in section.get("addresses") if not written.is_serial]


def unique(sections: Iterable[Values], key: str) -> Found:
    """Each section has its own value of a key."""
    first: dict[object, Values] = {}
    for section in sections:
        if (value := section.get(key)) is not None and (other := first.setdefault(value, section)) is not section:
            yield section.at(key), f"is that of {other.at()} too, and each has its own: write another"


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""Only a plain word is repeated: another key may be a secret, or control a terminal."""


def example_of(key: str) -> str | None:
    """A value of a key as it is written in TOML; None if no section has the key, or a policy has it."""
    return next((keys[key].example for keys in (TOP, *SECTIONS.values()) if key in keys and key not in POLICY), None)


_IN_A_FILE = "the name of a file that holds the key: this file never contains a key"
_KNOWN: dict[str, str] = {
    "private_key": f"is not known here: write private_key_file, {_IN_A_FILE}",
    **dict.fromkeys(("psk", "preshared_key"), f"is not known here: write psk_file, {_IN_A_FILE}"),
    **dict.fromkeys(
        ("address", "endpoint"),
        'is not known here: a [[peer]] has a list, addresses = ["10.13.0.2:5790"], and an [[endpoint]] has a url',
    ),
    "allowed_ips": "is not known here: write role and system_ids, which say what the peer may do",
    **dict.fromkeys(("attack", "radio"), "is of the man in the middle: `uavlink-mitm --config` reads such a file"),
}
"""The remedies for keys of WireGuard's files, and of the man in the middle's."""


def unknown_key(key: str, kind: str) -> str:
    """The message for a key that the sections of a kind do not have."""
    keys = SECTIONS.get(kind, TOP)
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[ -]", "_", key).lower()
    if key in TITLES:
        return f"does not belong here: write {TITLES[key]}, a section of its own"
    if plain in _KNOWN:
        return _KNOWN[plain]
    if key in TOP:
        return "does not belong here: write it at the top of the file, before the first section"
    if places := [TITLES[section] for section, others in SECTIONS.items() if key in others]:
        return f"does not belong here: write it in {' or '.join(places)}"
    known = [*keys, *(() if kind else TITLES)]
    if likely := meant(plain, known, cutoff=0.7):
        return f"is not known: did you mean {TITLES.get(likely, likely)}?"
    return f"is not known here: the keys are {', '.join(known)}"
