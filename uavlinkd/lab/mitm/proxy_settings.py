"""Between whom the man in the middle stands, and what it does: from a file, or from flags.

Every problem of a file is told at once. Nothing falls back to a default because it could not be read.
"""

from __future__ import annotations

import base64
import binascii
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError

from uavlinkd.system.addresses import Address, parse_address
from uavlinkd.core.constants import KEY_BYTES
from uavlinkd.lab.mitm.attack import AttackError, Surroundings, Way
from uavlinkd.lab.mitm.attacks import AttackSpec, attack_from_table
from uavlinkd.lab.mitm.radio import Bursts, Outage, RadioSettings

MAX_FILE_BYTES = 1 << 20
LOG_DETAIL = 1000
"""Interventions of a kind that are logged one by one; the others are counted."""


class SettingsError(ValueError):
    """What is wrong, one problem a line."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


@dataclass(frozen=True, slots=True)
class MitmPeer:
    """A daemon that is attacked."""

    name: str
    address: Address | None = None
    """Where it listens. None: learned from what it sends, and nobody can reach it before."""
    public_key: bytes | None = None
    """What the attacker has found out: enough to make ``mac1``."""


@dataclass(frozen=True, slots=True)
class MitmLink:
    """Two peers, and where each of them reaches the other: addresses of the man in the middle."""

    peers: tuple[str, str]
    listen: tuple[Address, Address]
    """For the first peer, where it believes the second to be; and the other way round. Port 0: any."""


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """All of it."""

    peers: tuple[MitmPeer, ...]
    links: tuple[MitmLink, ...]
    attacks: tuple[AttackSpec, ...] = ()
    radios: tuple[tuple[str, RadioSettings], ...] = ()
    """With the way of each, ``both`` or ``A>B``; the last that names a way counts."""
    seed: int = 0
    log: Path | None = None
    log_detail: int = LOG_DETAIL
    control_socket: Path | None = None

    @property
    def surroundings(self) -> Surroundings:
        """What the attacks know."""
        ways = tuple(way for link in self.links for way in (Way(*link.peers), Way(*link.peers).back))
        keys = {each.name: each.public_key for each in self.peers if each.public_key is not None}
        return Surroundings(ways, keys)

    def radio_of(self) -> dict[Way, RadioSettings]:
        """The radio of each direction that has one.

        Raises:
            AttackError: a way that is not there.
        """
        surroundings = self.surroundings
        return {way: settings for text, settings in self.radios for way in surroundings.select(text)}

    def check(self) -> list[str]:
        """What is wrong between the sections."""
        problems: list[str] = []
        names = [each.name for each in self.peers]
        if len(self.peers) < 2:
            problems.append("peer: a man in the middle stands between two peers at least")
        if len(set(names)) < len(names):
            problems.append("peer: a name stands for one peer: give each its own")
        if not self.links:
            problems.append("link: name the two peers of a link, and an address for each")
        for number, link in enumerate(self.links):
            unknown = [each for each in link.peers if each not in names]
            if unknown or link.peers[0] == link.peers[1]:
                problems.append(f"link[{number}].between: must name two of the peers, which are {', '.join(names)}")
        if len({frozenset(link.peers) for link in self.links}) < len(self.links):
            problems.append("link: two peers have one link")
        taken = [each for link in self.links for each in link.listen if each.port]
        if len(set(taken)) < len(taken):
            problems.append("link: each listen address serves one peer on one link")
        if not problems:
            problems += self._check_attacks()
        return problems

    def _check_attacks(self) -> list[str]:
        problems: list[str] = []
        for spec in self.attacks:
            try:
                spec.make(self.surroundings)
            except AttackError as error:
                problems.append(f"attack {spec.name}: {error}")
        try:
            self.radio_of()
        except AttackError as error:
            problems.append(f"radio: {error}")
        return problems


# What stands in a file.


def _peer_address(value: object) -> Address:
    address = parse_address(_text(value), allow_names=True)
    if address.is_wildcard:
        raise ValueError("is every address of a machine: write the one where the peer listens")
    return address


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError("must be text, in quotes")
    return value


def _name(value: object) -> str:
    text = _text(value)
    if not (0 < len(text) <= 32 and text.isascii() and text.replace("-", "").replace("_", "").isalnum()):
        raise ValueError("must be letters, digits, - and _, at most 32")
    if text == "both":
        raise ValueError("means both directions: choose another")
    return text


def parse_public_key(value: object) -> bytes:
    """A public key as ``uavlinkd pubkey`` prints it.

    Raises:
        ValueError: with what to write.
    """
    try:
        key = base64.b64decode(_text(value), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError("must be 44 characters of base64: what `uavlinkd pubkey` prints")
    return key


class _Section(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, hide_input_in_errors=True, allow_inf_nan=False
    )


_ListenAddress = Annotated[Address, PlainValidator(lambda value: parse_address(_text(value), allow_names=False))]
_PeerAddress = Annotated[Address, PlainValidator(_peer_address)]
_Name = Annotated[str, PlainValidator(_name)]


class _PeerSection(_Section):
    name: _Name
    address: _PeerAddress | None = None
    public_key: Annotated[bytes, PlainValidator(parse_public_key)] | None = None


class _LinkSection(_Section):
    between: Annotated[list[_Name], Field(min_length=2, max_length=2)]
    listen: Annotated[list[_ListenAddress], Field(min_length=2, max_length=2)]


class RadioSection(_Section):
    """One or both directions of an emulated radio; see :class:`RadioSettings`."""

    way: str = "both"
    loss: float = 0.0
    duplication: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    keeps_order: bool = False
    reordering: float = 0.0
    held_back_s: float = 0.05
    bits_per_s: float | None = None
    queue_bytes: int = 16384
    bursts_begin: float = 0.0
    """Probability that a burst of losses begins, for each datagram; 0: no bursts."""
    bursts_end: float = 0.25
    """Probability that it ends: a mean burst is 1 / bursts_end datagrams."""
    outage_at_s: float | None = None
    """Nothing passes from then on,"""
    outage_s: float = 1.0
    """for so long,"""
    outage_every_s: float | None = None
    """and again after so long."""

    def settings(self) -> RadioSettings:
        """For the emulator.

        Raises:
            ValueError: for a value that no radio has.
        """
        same = ("loss", "duplication", "delay_s", "jitter_s", "keeps_order", "reordering", "held_back_s")
        outages: tuple[Outage, ...] = ()
        if self.outage_at_s is not None:
            outages = (Outage(self.outage_at_s, self.outage_at_s + self.outage_s, self.outage_every_s),)
        return RadioSettings(
            **{name: getattr(self, name) for name in same},
            bits_per_s=self.bits_per_s,
            queue_bytes=self.queue_bytes,
            bursts=Bursts(self.bursts_begin, self.bursts_end) if self.bursts_begin else None,
            outages=outages,
        )


class _FileSection(_Section):
    seed: int = 0
    log: str | None = None
    log_detail: Annotated[int, Field(ge=0, le=1_000_000)] = LOG_DETAIL
    control_socket: str | None = None
    peer: list[_PeerSection] = []
    link: list[_LinkSection] = []
    attack: list[dict[str, Any]] = []
    radio: list[RadioSection] = []


def load_proxy_settings(path: Path) -> ProxySettings:
    """The settings in a TOML file. Files that it names are relative to it.

    Raises:
        SettingsError: with every problem of the file.
    """
    try:
        return _from_table(_read(path), path.absolute().parent)
    except SettingsError as error:
        raise SettingsError([f"{path}: {problem}" for problem in error.problems]) from None


def _from_table(table: Mapping[str, Any], folder: Path) -> ProxySettings:
    problems: list[str] = []
    try:
        found = _FileSection.model_validate(table)
    except ValidationError as error:
        raise SettingsError([_problem(each["loc"], each["msg"]) for each in error.errors()]) from None
    attacks: list[AttackSpec] = []
    for number, each in enumerate(found.attack):
        try:
            attacks.append(attack_from_table(each))
        except AttackError as error:
            problems.append(f"attack[{number}]: {error}")
    radios: list[tuple[str, RadioSettings]] = []
    for number, section in enumerate(found.radio):
        try:
            radios.append((section.way, section.settings()))
        except ValueError as error:
            problems.append(f"radio[{number}]: {error}")
    settings = ProxySettings(
        peers=tuple(MitmPeer(each.name, each.address, each.public_key) for each in found.peer),
        links=tuple(
            MitmLink((each.between[0], each.between[1]), (each.listen[0], each.listen[1])) for each in found.link
        ),
        attacks=tuple(attacks),
        radios=tuple(radios),
        seed=found.seed,
        log=None if found.log is None else folder / found.log,
        log_detail=found.log_detail,
        control_socket=None if found.control_socket is None else folder / found.control_socket,
    )
    problems += settings.check()
    if problems:
        raise SettingsError(problems)
    return settings


def _problem(location: tuple[int | str, ...], message: str) -> str:
    parts = [f"[{each}]" if isinstance(each, int) else f".{each[:32]}" for each in location]
    plain = message.removeprefix("Value error, ").replace("Extra inputs are not permitted", "Is not known here")
    return f"{''.join(parts).lstrip('.')}: {plain[0].lower()}{plain[1:]}"


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise SettingsError([f"cannot be read: {error.strerror}"]) from None
    if len(content) > MAX_FILE_BYTES:
        raise SettingsError(["is over a megabyte: this is no configuration"])
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise SettingsError([f"is no TOML that can be read: {error}"]) from None


# What stands in flags.


def parse_peer(text: str) -> MitmPeer:
    """``NAME=HOST:PORT`` or ``NAME=HOST:PORT,PUBLICKEY``.

    Raises:
        ValueError: with what to write.
    """
    name, _, rest = text.partition("=")
    address, comma, key = rest.partition(",")
    return MitmPeer(_name(name), _peer_address(address), parse_public_key(key) if comma else None)


def parse_link(text: str) -> MitmLink:
    """``A@HOST:PORT,B@HOST:PORT``: where A, and where B, finds the other.

    Raises:
        ValueError: with what to write.
    """
    ends = [part.partition("@") for part in text.split(",")]
    if len(ends) != 2 or not all(at for _, at, _ in ends):
        raise ValueError("is written A@HOST:PORT,B@HOST:PORT")
    (one, _, for_one), (other, _, for_other) = ends
    listen = (parse_address(for_one, allow_names=False), parse_address(for_other, allow_names=False))
    return MitmLink((_name(one), _name(other)), listen)


def parse_radio(text: str) -> tuple[str, RadioSettings]:
    """``key=value,key=value``: the keys of :class:`RadioSection`.

    Raises:
        ValueError: with what to write.
    """
    values = {key.strip(): value.strip() for key, _, value in (pair.partition("=") for pair in text.split(","))}
    try:
        section = RadioSection.model_validate_strings(values)
    except ValidationError as error:
        raise ValueError("; ".join(_problem(each["loc"], each["msg"]) for each in error.errors())) from None
    return section.way, section.settings()


def overridden(settings: ProxySettings, **flags: Any) -> ProxySettings:
    """The settings, with the flags that were given (neither None nor empty) in place of what the file says."""
    return replace(settings, **{name: value for name, value in flags.items() if value not in (None, ())})
