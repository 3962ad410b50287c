"""The settings of the man in the middle, from a file.

All problems of a file are reported at once. An unreadable value is an error, never replaced by a default.
"""

from __future__ import annotations

import base64
import binascii
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError

from uavlinkd.lab.mitm.attack import AttackContext, AttackError, Direction
from uavlinkd.lab.mitm.attacks import AttackSpec, attack_from_table
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.system.addresses import Address, parse_address


class SettingsError(ValueError):
    """The settings are wrong: one problem per line."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


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


def _public_key(value: object) -> bytes:
    try:
        key = base64.b64decode(_text(value), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError("must be 44 characters of base64: what `uavlinkd pubkey` prints")
    return key


_ListenAddress = Annotated[Address, PlainValidator(lambda value: parse_address(_text(value), allow_names=False))]
_Name = Annotated[str, PlainValidator(_name)]


@dataclass(frozen=True, slots=True)
class MitmPeer:
    """A daemon that is attacked: a section of the file."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: _Name
    address: Annotated[Address, PlainValidator(_peer_address)] | None = None
    """Where it listens. None: learned from its datagrams; it is unreachable before."""
    public_key: Annotated[bytes, PlainValidator(_public_key)] | None = None
    """If known, attacks can compute a valid ``mac1``."""


@dataclass(frozen=True, slots=True)
class MitmLink:
    """Two peers, and the addresses of the man in the middle where each reaches the other: a section of the file.

    A second link between the same peers is a second path.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    peers: Annotated[tuple[_Name, _Name], Field(alias="between")]
    listen: tuple[_ListenAddress, _ListenAddress]
    """The address for the first peer, and the one for the second. Port 0: any free port."""


@dataclass(frozen=True, slots=True)
class MitmRadio(RadioSettings):
    """An emulated radio in one direction or both: a section of the file."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    direction: str = "both"


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """All settings of the man in the middle."""

    peers: tuple[MitmPeer, ...]
    links: tuple[MitmLink, ...]
    attacks: tuple[AttackSpec, ...] = ()
    radios: tuple[tuple[str, RadioSettings], ...] = ()
    """Direction (``both``, ``A>B``, or of one path ``both/2``) and settings. The last entry applies."""
    seed: int = 0
    """Of all random choices."""
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
        """The radio of each direction that has one. Raises AttackError if there is no such direction."""
        context = self.context
        return {direction: settings for text, settings in self.radios for direction in context.select(text)}

    def check(self) -> list[str]:
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


class _Section(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, hide_input_in_errors=True, allow_inf_nan=False
    )


def _attack(value: object) -> AttackSpec:
    if not isinstance(value, dict):
        raise ValueError("must be a table")
    return attack_from_table(value)


class _FileSection(_Section):
    seed: int = 0
    control_socket: str | None = None
    peer: list[MitmPeer] = []
    link: list[MitmLink] = []
    attack: list[Annotated[Any, PlainValidator(_attack)]] = []
    radio: list[MitmRadio] = []


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
    try:
        file = _FileSection.model_validate(table)
    except ValidationError as error:
        raise SettingsError([_problem(item["loc"], item["msg"]) for item in error.errors()]) from None
    settings = ProxySettings(
        peers=tuple(file.peer),
        links=tuple(file.link),
        attacks=tuple(file.attack),
        radios=tuple((radio.direction, radio) for radio in file.radio),
        seed=file.seed,
        control_socket=None if file.control_socket is None else folder / file.control_socket,
    )
    problems = settings.check()
    if problems:
        raise SettingsError(problems)
    return settings


def _problem(location: tuple[int | str, ...], message: str) -> str:
    parts = [f"[{key}]" if isinstance(key, int) else f".{key[:32]}" for key in location]
    plain = message.removeprefix("Value error, ")
    for words in ("Extra inputs are not permitted", "Unexpected keyword argument"):
        plain = plain.replace(words, "Is an unknown key")
    return f"{''.join(parts).lstrip('.')}: {plain[0].lower()}{plain[1:]}"


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError([f"cannot be read: {error.strerror}"]) from None
    except (ValueError, RecursionError) as error:
        raise SettingsError([f"is not valid TOML: {error}"]) from None
