"""Every attack by its name, and attacks from the text or the table that asks for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from random import Random
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from uavlinkd.lab.mitm.attack import Attack, AttackError, Options, Surroundings, describe_options
from uavlinkd.lab.mitm.attacks import (
    floods,
    forgery,
    key_exchange as handshake,
    replays as replay,
    roaming,
    stretch,
    withholding as traffic,
)

_ALL: tuple[type[Attack[Any]], ...] = (
    handshake.TamperKey,
    handshake.ReplaceKey,
    handshake.RandomKey,
    handshake.SuiteDowngrade,
    handshake.InvalidElement,
    handshake.CorruptShare,
    handshake.AlterIndices,
    handshake.AlterMacs,
    handshake.SpliceHandshake,
    replay.ReplayInitiation,
    replay.ReplayResponse,
    replay.ReplayCookie,
    replay.StolenCookie,
    replay.ReplayData,
    replay.Duplicate,
    replay.Reflect,
    replay.Misroute,
    forgery.BitFlip,
    forgery.Truncate,
    forgery.Extend,
    forgery.Splice,
    forgery.CounterJump,
    forgery.AlterFrame,
    forgery.TamperTag,
    forgery.ForgeData,
    forgery.FloodEnvelopes,
    forgery.RawMavlink,
    floods.FloodInitiations,
    floods.FloodReplays,
    floods.FloodGarbage,
    floods.StrangerScan,
    floods.AmplificationProbe,
    floods.ForgeHints,
    floods.ForgeCookie,
    roaming.Roam,
    roaming.Wander,
    traffic.DropAny,
    traffic.DropMessage,
    traffic.DropHeartbeats,
    traffic.BlockRekey,
    traffic.Blackout,
    traffic.Hold,
    traffic.Cross,
    traffic.Reorder,
    stretch.Stretch,
    stretch.StretchOneWay,
)

ATTACKS: Mapping[str, type[Attack[Any]]] = MappingProxyType({each.name: each for each in _ALL})
"""By name, in the order of the list."""


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """An attack that was asked for, its parameters checked."""

    name: str
    options: Options

    def __str__(self) -> str:
        given = self.options.model_dump(exclude_unset=True)
        return ",".join([self.name, *(f"{key}={value}" for key, value in given.items())])

    def make(self, surroundings: Surroundings, seed: int | str = 0, now: float = 0.0) -> Attack[Any]:
        """The attack. The same seed makes the same one.

        Raises:
            AttackError: these surroundings are not what it needs: another peer, a public key.
        """
        return ATTACKS[self.name](self.options, surroundings, Random(f"{self.name} {seed}"), now)  # noqa: S311  luck, no secret


def parse_attack(text: str) -> AttackSpec:
    """``NAME`` or ``NAME,key=value,key=value``, as on the command line.

    Raises:
        AttackError: with what to write instead.
    """
    name, *pairs = text.split(",")
    values: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key.strip() in values:
            raise AttackError(
                f"{_attack(name).name}: parameters are written key=value, each once, with commas between"
            )
        values[key.strip()] = value.strip()
    model = _attack(name).options_model
    return _spec(name, lambda: model.model_validate_strings(values))


def attack_from_table(table: Mapping[str, Any]) -> AttackSpec:
    """A table with ``name`` and parameters, as in a configuration file.

    Raises:
        AttackError: with what to write instead.
    """
    values = dict(table)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise AttackError('an attack has a name: write name = "replay-data"')
    model = _attack(name).options_model
    return _spec(name, lambda: model.model_validate(values, strict=False))


def _attack(name: str) -> type[Attack[Any]]:
    found = ATTACKS.get(name.strip())
    if found is None:
        close = get_close_matches(name.strip(), ATTACKS, n=1)
        meant = f": did you mean {close[0]}?" if close else ": see uavlink-mitm --list"
        raise AttackError(f"there is no such attack{meant}")
    return found


def _spec(name: str, read: Any) -> AttackSpec:
    attack = _attack(name)
    try:
        return AttackSpec(attack.name, read())
    except ValidationError as error:
        problems = [_problem(attack, details["loc"], details["type"], details["msg"]) for details in error.errors()]
        raise AttackError(f"{attack.name}: {'; '.join(problems)}") from None


def _problem(attack: type[Attack[Any]], location: tuple[int | str, ...], kind: str, message: str) -> str:
    key = str(location[0]) if location else ""
    if kind == "extra_forbidden":
        return f"has no such parameter; its parameters are {', '.join(attack.options_model.model_fields)}"
    return f"{key}: {message[0].lower()}{message[1:]}"


def list_attacks() -> str:
    """Every attack with its parameters, as text for a terminal."""
    lines: list[str] = []
    for attack in _ALL:
        lines.append(attack.name)
        lines.append(f"    {attack.summary()}.")
        for name, default, meaning in describe_options(attack.options_model):
            if name not in Options.model_fields or default != Options.model_fields[name].default:
                lines.append(f"      {name}={_shown(default)}  {meaning}")
    lines.append("every attack")
    for name, default, meaning in describe_options(Options):
        lines.append(f"      {name}={_shown(default)}  {meaning}")
    return "\n".join(lines)


def _shown(default: Any) -> str:
    if default is None:
        return ""
    return (
        str(default).lower()
        if isinstance(default, bool)
        else f"{default:g}"
        if isinstance(default, float)
        else str(default)
    )
