"""What a configuration file is made of: kinds of values, keys, and the values of a section.

A kind is a function. It returns the value that the daemon uses, or raises ValueError with the message for the person.
The message never repeats the value, which may be a secret in the wrong place. An example of the key follows a message
without a remedy. Nothing is converted: a number in quotation marks is a mistake.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

Kind = Callable[[Any], Any]


class ListError(ValueError):
    """The messages about values of a list, by their index."""

    def __init__(self, messages: Mapping[int, str]) -> None:
        super().__init__("; ".join(messages.values()))
        self.messages = messages


def boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("must be true or false, without quotes")
    return value


def anything(value: Any) -> Any:
    return value


def text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("must be text in quotes")
    return value


class Number:
    """A kind: a number in a range."""

    def __init__(self, least: float, most: float, *, is_whole: bool = False) -> None:
        self.least, self.most, self.is_whole = least, most, is_whole

    def __call__(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int if self.is_whole else int | float):
            raise ValueError(f"must be a {'whole ' if self.is_whole else ''}number, without quotes")
        if not self.least <= value <= self.most:  # also of NaN
            raise ValueError(f"must be from {self.least:.12g} to {self.most:.12g}")
        return value if self.is_whole else float(value)


def integer(least: int, most: int) -> Number:
    return Number(least, most, is_whole=True)


class Choice:
    """A kind: one of a few values."""

    def __init__(self, *values: str | int) -> None:
        self.values = values

    def __call__(self, value: Any) -> str | int:
        for one in self.values:
            if type(value) is type(one) and value == one:
                return one
        *most, last = (f'"{one}"' if isinstance(one, str) else str(one) for one in self.values)
        raise ValueError(f"must be {', '.join(most)} or {last}")


def each(kind: Kind, least: int = 0) -> Kind:
    """The kind of a list of different values, at least so many."""

    def read_list(value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise ValueError("must be a list")
        values, messages = list[Any](), dict[int, str]()
        for index, item in enumerate(value):
            try:
                values.append(kind(item))
            except ValueError as error:
                messages[index] = str(error)
        if messages:
            raise ListError(messages)
        if len(set(values)) != len(values):
            raise ValueError("names one twice: write each once")
        if len(values) < least:
            raise ValueError("is empty")
        return values

    return read_list


REQUIRED: Final = object()
"""The default of a key that a section must have."""


class Key(NamedTuple):
    """A key: the kind of its value, its default, and an example as it is written in TOML."""

    kind: Kind
    default: Any = REQUIRED
    written: str = ""

    @property
    def example(self) -> str:
        """A value as it is written in TOML. A person who writes a boolean wants another value than the default."""
        if self.written:
            return self.written
        if isinstance(self.default, bool):
            return str(not self.default).lower()
        return str(self.default) if isinstance(self.default, int | float) else f'"{self.default}"'


Keys = Mapping[str, Key]


class Values(NamedTuple):
    """The values of one section: the valid ones that are written, and the keys whose values are invalid."""

    section: str  # `peer[1]`; empty for the top of the file
    keys: Keys
    valid: dict[str, Any]
    invalid: frozenset[str] = frozenset()

    @property
    def kind(self) -> str:
        """``peer`` of ``peer[1]``."""
        return self.section.partition("[")[0]

    def get(self, key: str) -> Any:
        """The valid value of a key, or its default; None without a default."""
        default = self.keys[key].default if key in self.keys else None
        return self.valid.get(key, None if default is REQUIRED else default)

    def at(self, key: str = "") -> str:
        """The place of a key, or of the section: ``peer[1].public_key (drone1)``."""
        path = ".".join(part for part in (self.section, key) if part)
        name = self.valid.get("name") if self.section else None
        return f"{path} ({name})" if name else path

    def lacks(self, key: str) -> bool:
        """Whether the key is not written, or its value is empty. False if the value is invalid."""
        return not self.valid.get(key) and key not in self.invalid


def read(keys: Keys, table: Mapping[str, Any], section: str = "") -> tuple[Values, list[tuple[str, str]]]:
    """The values of a section, and every problem with its place in the section. Unknown keys are no matter of it."""
    valid, problems = dict[str, Any](), list[tuple[str, str]]()
    for name, key in keys.items():
        if name not in table:
            if key.default is REQUIRED:
                problems.append((name, f"is missing: write {name} = {key.example}"))
            continue
        try:
            valid[name] = key.kind(table[name])
        except ListError as error:
            problems += [(f"{name}[{index}]", message) for index, message in error.messages.items()]
        except ValueError as error:
            remedy = "" if "write" in str(error) else f": write {name} = {key.example}"
            problems.append((name, f"{error}{remedy}"))
    invalid = frozenset(keys) & {place.partition("[")[0] for place, _ in problems}
    return Values(section, keys, valid, invalid), problems
