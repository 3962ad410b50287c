"""The settings of the man in the middle, from a file or from command-line options.

All problems of a file are reported at once. An unreadable value is an error, never replaced by a default.
"""

from __future__ import annotations

import base64
import binascii
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError

from uavlinkd.core.constants import KEY_BYTES
from uavlinkd.lab.mitm.attack import AttackContext, AttackError, Direction
from uavlinkd.lab.mitm.attacks import AttackSpec, attack_from_table
from uavlinkd.lab.mitm.radio import Bursts, Outage, RadioSettings
from uavlinkd.system.addresses import Address, parse_address

MAX_FILE_BYTES = 1 << 20
LOG_DETAIL = 1000
"""Interventions of one attack and operation that have a log line each. Later ones are counted."""


class SettingsError(ValueError):
    """The settings are wrong: one problem per line."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


@dataclass(frozen=True, slots=True)
class MitmPeer:
    """A daemon that is attacked."""

    name: str
    address: Address | None = None
    """Where it listens. None: learned from its datagrams; it is unreachable before."""
    public_key: bytes | None = None
    """If known, attacks can compute a valid ``mac1``."""


@dataclass(frozen=True, slots=True)
class MitmLink:
    """Two peers, and the addresses of the man in the middle where each reaches the other.

    A second link between the same peers is a second path.
    """

    peers: tuple[str, str]
    listen: tuple[Address, Address]
    """The address for the first peer, and the one for the second. Port 0: any free port."""


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """All settings of the man in the middle."""

    peers: tuple[MitmPeer, ...]
    links: tuple[MitmLink, ...]
    attacks: tuple[AttackSpec, ...] = ()
    radios: tuple[tuple[str, RadioSettings], ...] = ()
    """Direction (``both``, ``A>B``, or of one path ``both/2``) and settings. The last entry applies."""
    seed: int = 0
    log: Path | None = None
    log_detail: int = LOG_DETAIL
    control_socket: Path | None = None

    @property
    def listeners(self) -> dict[Direction, Address]:
        """Where the sender of each direction reaches the receiver. Links between the same peers are paths."""
        listeners: dict[Direction, Address] = {}
        paths = Counter[frozenset[str]]()
        for link in self.links:
            pair = frozenset(link.peers)
            paths[pair] += 1
            direction = Direction(*link.peers, paths[pair])
            listeners[direction], listeners[direction.reverse] = link.listen
        return listeners

    @property
    def context(self) -> AttackContext:
        """The directions and public keys that the attacks know."""
        keys = {peer.name: peer.public_key for peer in self.peers if peer.public_key is not None}
        return AttackContext(tuple(self.listeners), keys)

    def radio_of(self) -> dict[Direction, RadioSettings]:
        """The radio of each direction that has one.

        Raises:
            AttackError: there is no such direction.
        """
        context = self.context
        return {direction: settings for text, settings in self.radios for direction in context.select(text)}

    def check(self) -> list[str]:
        """The inconsistencies between sections."""
        problems: list[str] = []
        names = [peer.name for peer in self.peers]
        if len(self.peers) < 2:
            problems.append("peer: at least two peers are required")
        if len(set(names)) < len(names):
            problems.append("peer: two peers have the same name: names must be unique")
        if not self.links:
            problems.append("link: at least one link is required")
        for number, link in enumerate(self.links):
            unknown = [name for name in link.peers if name not in names]
            if unknown or link.peers[0] == link.peers[1]:
                problems.append(f"link[{number}].between: must name two of the peers, which are {', '.join(names)}")
        listening = [address for link in self.links for address in link.listen if address.port]
        if len(set(listening)) < len(listening):
            problems.append("link: a listen address is used twice: each must be unique")
        if not problems:
            problems += self._check_attacks()
        return problems

    def _check_attacks(self) -> list[str]:
        problems: list[str] = []
        for spec in self.attacks:
            try:
                spec.make(self.context)
            except AttackError as error:
                problems.append(f"attack {spec.name}: {error}")
        try:
            self.radio_of()
        except AttackError as error:
            problems.append(f"radio: {error}")
        return problems


# The file.


def _peer_address(value: object) -> Address:
    address = parse_address(_text(value), allow_names=True)
    if address.is_wildcard:
        raise ValueError("is a wildcard address: write the address where the peer listens")
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
        raise ValueError("is reserved for both directions: choose another name")
    return text


def parse_public_key(value: object) -> bytes:
    """Decode a public key as ``uavlinkd pubkey`` prints it.

    Raises:
        ValueError: it is not a public key.
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


_PERFECT = RadioSettings()


class RadioSection(_Section):
    """One or both directions of an emulated radio; see :class:`RadioSettings`."""

    direction: str = "both"
    loss: float = _PERFECT.loss
    duplication: float = _PERFECT.duplication
    delay_s: float = _PERFECT.delay_s
    jitter_s: float = _PERFECT.jitter_s
    keeps_order: bool = _PERFECT.keeps_order
    reordering: float = _PERFECT.reordering
    held_back_s: float = _PERFECT.held_back_s
    bits_per_s: float | None = _PERFECT.bits_per_s
    queue_bytes: int = _PERFECT.queue_bytes
    bursts_begin: float = 0.0
    """Probability that a burst of losses begins, for each datagram; 0: no bursts."""
    bursts_end: float = 0.25
    """Probability that a burst ends, for each datagram: a mean burst is 1 / bursts_end datagrams long."""
    outage_at_s: float | None = None
    """When the outage begins, in seconds after the start; None: no outage."""
    outage_s: float = 1.0
    """Its duration."""
    outage_every_s: float | None = None
    """The interval at which it repeats; None: once."""

    def settings(self) -> RadioSettings:
        """The settings of the emulator.

        Raises:
            ValueError: a value is out of range.
        """
        same = self.model_fields_set & {field.name for field in fields(RadioSettings)}
        outages: tuple[Outage, ...] = ()
        if self.outage_at_s is not None:
            outages = (Outage(self.outage_at_s, self.outage_at_s + self.outage_s, self.outage_every_s),)
        return RadioSettings(
            **{name: getattr(self, name) for name in same},
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
    """Read the settings from a TOML file. Paths in it are relative to its folder.

    Raises:
        SettingsError: with all problems of the file.
    """
    try:
        return _from_table(_read(path), path.absolute().parent)
    except SettingsError as error:
        raise SettingsError([f"{path}: {problem}" for problem in error.problems]) from None


def _from_table(table: Mapping[str, Any], folder: Path) -> ProxySettings:
    problems: list[str] = []
    try:
        file = _FileSection.model_validate(table)
    except ValidationError as error:
        raise SettingsError([_problem(item["loc"], item["msg"]) for item in error.errors()]) from None
    attacks: list[AttackSpec] = []
    for number, attack in enumerate(file.attack):
        try:
            attacks.append(attack_from_table(attack))
        except AttackError as error:
            problems.append(f"attack[{number}]: {error}")
    radios: list[tuple[str, RadioSettings]] = []
    for number, section in enumerate(file.radio):
        try:
            radios.append((section.direction, section.settings()))
        except ValueError as error:
            problems.append(f"radio[{number}]: {error}")
    settings = ProxySettings(
        peers=tuple(MitmPeer(peer.name, peer.address, peer.public_key) for peer in file.peer),
        links=tuple(
            MitmLink((link.between[0], link.between[1]), (link.listen[0], link.listen[1])) for link in file.link
        ),
        attacks=tuple(attacks),
        radios=tuple(radios),
        seed=file.seed,
        log=None if file.log is None else folder / file.log,
        log_detail=file.log_detail,
        control_socket=None if file.control_socket is None else folder / file.control_socket,
    )
    problems += settings.check()
    if problems:
        raise SettingsError(problems)
    return settings


def _problem(location: tuple[int | str, ...], message: str) -> str:
    parts = [f"[{key}]" if isinstance(key, int) else f".{key[:32]}" for key in location]
    plain = message.removeprefix("Value error, ").replace("Extra inputs are not permitted", "Is an unknown key")
    return f"{''.join(parts).lstrip('.')}: {plain[0].lower()}{plain[1:]}"


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise SettingsError([f"cannot be read: {error.strerror}"]) from None
    if len(content) > MAX_FILE_BYTES:
        raise SettingsError(["is larger than 1 MiB: this is not a configuration"])
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise SettingsError([f"is not valid TOML: {error}"]) from None


# Command-line options.


def parse_peer(text: str) -> MitmPeer:
    """Parse ``NAME=HOST:PORT`` or ``NAME=HOST:PORT,PUBLICKEY``.

    Raises:
        ValueError: the text is malformed.
    """
    name, _, rest = text.partition("=")
    address, comma, key = rest.partition(",")
    return MitmPeer(_name(name), _peer_address(address), parse_public_key(key) if comma else None)


def parse_link(text: str) -> MitmLink:
    """Parse ``A@HOST:PORT,B@HOST:PORT``: where A reaches B, and where B reaches A.

    Raises:
        ValueError: the text is malformed.
    """
    ends = [part.partition("@") for part in text.split(",")]
    if len(ends) != 2 or not all(at for _, at, _ in ends):
        raise ValueError("must be A@HOST:PORT,B@HOST:PORT")
    (one, _, for_one), (other, _, for_other) = ends
    listen = (parse_address(for_one, allow_names=False), parse_address(for_other, allow_names=False))
    return MitmLink((_name(one), _name(other)), listen)


def parse_radio(text: str) -> tuple[str, RadioSettings]:
    """Parse ``key=value,key=value`` with the keys of :class:`RadioSection`.

    Raises:
        ValueError: the text is malformed.
    """
    values = {key.strip(): value.strip() for key, _, value in (pair.partition("=") for pair in text.split(","))}
    try:
        section = RadioSection.model_validate_strings(values)
    except ValidationError as error:
        raise ValueError("; ".join(_problem(item["loc"], item["msg"]) for item in error.errors())) from None
    return section.direction, section.settings()


def overridden(settings: ProxySettings, **flags: Any) -> ProxySettings:
    """The settings, overridden by the options that are neither None nor empty."""
    return replace(settings, **{name: value for name, value in flags.items() if value not in (None, ())})
