"""The list of all attacks, and parsers for the text or table that selects one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from inspect import isclass
from random import Random
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from uavlinkd.lab.mitm.attack import Attack, AttackContext, AttackError
from uavlinkd.lab.mitm.attacks import floods, forgery, key_exchange, replays, withholding
from uavlinkd.lab.mitm.options import COMMON, Options, describe_options

_MODULES = (key_exchange, replays, forgery, floods, withholding)
_ALL: list[type[Attack]] = [
    value
    for module in _MODULES
    for value in vars(module).values()
    if isclass(value) and issubclass(value, Attack) and value.name
]

ATTACKS: Mapping[str, type[Attack]] = MappingProxyType({attack.name: attack for attack in _ALL})
"""By name, in the order of the list."""


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """A selected attack and its validated parameters."""

    kind: type[Attack]
    options: Options

    @property
    def name(self) -> str:
        return self.kind.name

    def __str__(self) -> str:
        options = self.options.model_dump(exclude_unset=True)
        return ",".join([self.name, *(f"{key}={value}" for key, value in options.items())])

    def make(self, context: AttackContext, seed: int | str = 0, now: float = 0.0) -> Attack:
        """Create the attack. Equal seeds create equal attacks.

        Raises:
            AttackError: the attack needs another peer or a public key.
        """
        return self.kind(self.options, context, Random(f"{self.name} {seed}"), now)  # noqa: S311  not a secret


def parse_attack(text: str, attacks: Mapping[str, type[Attack]] = ATTACKS) -> AttackSpec:
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


def _attack(name: str, attacks: Mapping[str, type[Attack]]) -> type[Attack]:
    attack = attacks.get(name.strip())
    if attack is None:
        close = get_close_matches(name.strip(), attacks, n=1)
        hint = f"did you mean {close[0]}?" if close else f"the attacks are {', '.join(attacks)}"
        raise AttackError(f"there is no such attack: {hint}")
    return attack


def _spec(attack: type[Attack], read: Callable[[], Options]) -> AttackSpec:
    try:
        return AttackSpec(attack, read())
    except ValidationError as error:
        problems = [_problem(attack, details["loc"], details["type"], details["msg"]) for details in error.errors()]
        raise AttackError(f"{attack.name}: {'; '.join(problems)}") from None


def _problem(attack: type[Attack], location: tuple[int | str, ...], kind: str, message: str) -> str:
    key = str(location[0]) if location else ""
    if kind == "extra_forbidden":
        return f"has no such parameter; its parameters are {', '.join(attack.options_model.model_fields)}"
    return f"{key}: {message[0].lower()}{message[1:]}"


def list_attacks(attacks: Mapping[str, type[Attack]] = ATTACKS) -> str:
    """All these attacks and their parameters, as text for a terminal."""
    lines: list[str] = []
    for attack in attacks.values():
        lines.append(attack.name)
        lines.append(f"    {attack.summary()}.")
        for name, default, meaning in describe_options(attack.options_model):
            if name not in COMMON or default != Options.model_fields[name].default:
                lines.append(f"      {name}={_shown(default)}  {meaning}")
    lines.append("every attack")
    for name, default, meaning in describe_options(Attack.options_model):
        lines.append(f"      {name}={_shown(default)}  {meaning}")
    return "\n".join(lines)


def _shown(default: Any) -> str:
    if isinstance(default, bool):
        return str(default).lower()
    return "" if default is None else f"{default:g}" if isinstance(default, float) else str(default)
