"""The list of all attacks, and parsers for the text or table that selects one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from random import Random
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from uavlinkd.lab.mitm.attack import Attack, AttackContext, AttackError, AttackObject, Options, describe_options
from uavlinkd.lab.mitm.attacks import floods, forgery, key_exchange, replays, roaming, stretch, withholding
from uavlinkd.lab.mitm.inside import InsideData

_ALL: tuple[type[Attack[Any]], ...] = (
    key_exchange.TamperKey,
    key_exchange.ReplaceKey,
    key_exchange.RandomKey,
    key_exchange.SuiteDowngrade,
    key_exchange.InvalidElement,
    key_exchange.CorruptShare,
    key_exchange.AlterIndices,
    key_exchange.AlterMacs,
    key_exchange.SpliceHandshake,
    replays.ReplayInitiation,
    replays.ReplayResponse,
    replays.ReplayCookie,
    replays.StolenCookie,
    replays.ReplayData,
    replays.Duplicate,
    replays.Reflect,
    replays.Misroute,
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
    withholding.DropAny,
    withholding.DropMessage,
    withholding.DropHeartbeats,
    withholding.BlockRekey,
    withholding.Blackout,
    withholding.Hold,
    withholding.Move,
    withholding.Cross,
    withholding.Reorder,
    stretch.Stretch,
    stretch.StretchOneWay,
)

ATTACKS: Mapping[str, type[Attack[Any]]] = MappingProxyType({attack.name: attack for attack in _ALL})
"""By name, in the order of the list."""


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """A selected attack and its validated parameters."""

    kind: type[Attack[Any]]
    options: Options

    @property
    def name(self) -> str:
        """The name of the attack."""
        return self.kind.name

    def __str__(self) -> str:
        options = self.options.model_dump(exclude_unset=True)
        return ",".join([self.name, *(f"{key}={value}" for key, value in options.items())])

    def make(self, context: AttackContext, seed: int | str = 0, now: float = 0.0) -> Attack[Any]:
        """Create the attack. Equal seeds create equal attacks.

        Raises:
            AttackError: the attack needs another peer or a public key.
        """
        return self.kind(self.options, context, Random(f"{self.name} {seed}"), now)  # noqa: S311  not a secret

    def place(self, context: AttackContext, seed: int | str = 0, now: float = 0.0) -> AttackObject:
        """Create the attack for the datagrams that its option ``inside`` selects.

        Raises:
            AttackError: the attack needs another peer or a public key.
        """
        attack = self.make(context, seed, now)
        return InsideData(attack) if self.options.inside else attack


def parse_attack(text: str, attacks: Mapping[str, type[Attack[Any]]] = ATTACKS) -> AttackSpec:
    """Parse ``NAME`` or ``NAME,key=value,key=value``, as on the command line. ``attacks``: those to choose from.

    Raises:
        AttackError: unknown attack or wrong parameters. The message says what to write instead.
    """
    name, *pairs = text.split(",")
    attack = _attack(name, attacks)
    values: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key.strip() in values:
            raise AttackError(f"{attack.name}: parameters are written key=value, each once, with commas between")
        values[key.strip()] = value.strip()
    return _spec(attack, lambda: attack.options_model.model_validate_strings(values))


def attack_from_table(table: Mapping[str, Any]) -> AttackSpec:
    """Read a table with ``name`` and parameters, as in a configuration file.

    Raises:
        AttackError: unknown attack or wrong parameters. The message says what to write instead.
    """
    values = dict(table)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise AttackError('the attack has no name: write, for example, name = "replay-data"')
    attack = _attack(name, ATTACKS)
    return _spec(attack, lambda: attack.options_model.model_validate(values, strict=False))


def _attack(name: str, attacks: Mapping[str, type[Attack[Any]]]) -> type[Attack[Any]]:
    attack = attacks.get(name.strip())
    if attack is None:
        close = get_close_matches(name.strip(), attacks, n=1)
        hint = f"did you mean {close[0]}?" if close else f"the attacks are {', '.join(attacks)}"
        raise AttackError(f"there is no such attack: {hint}")
    return attack


def _spec(attack: type[Attack[Any]], read: Callable[[], Options]) -> AttackSpec:
    try:
        return AttackSpec(attack, read())
    except ValidationError as error:
        problems = [_problem(attack, details["loc"], details["type"], details["msg"]) for details in error.errors()]
        raise AttackError(f"{attack.name}: {'; '.join(problems)}") from None


def _problem(attack: type[Attack[Any]], location: tuple[int | str, ...], kind: str, message: str) -> str:
    key = str(location[0]) if location else ""
    if kind == "extra_forbidden":
        return f"has no such parameter; its parameters are {', '.join(attack.options_model.model_fields)}"
    return f"{key}: {message[0].lower()}{message[1:]}"


def list_attacks(attacks: Mapping[str, type[Attack[Any]]] = ATTACKS) -> str:
    """All these attacks and their parameters, as text for a terminal."""
    lines: list[str] = []
    for attack in attacks.values():
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
