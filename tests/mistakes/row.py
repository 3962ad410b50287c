"""A mistake, what is expected of `check`, the logs and `status`, and what they said."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tests.mistakes.scene import Scene

Side = Literal["here", "there"]


@dataclass(frozen=True, slots=True)
class Sign:
    """A finding in `status` that is expected: side, cause, and the essential words of its remedy (a pattern)."""

    side: Side
    cause: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Mistake:
    """One row. ``check`` and ``command`` are patterns of what `check`, or the command itself, prints."""

    row: str
    make: Callable[[Scene], Awaitable[None]]
    """Makes the mistake. If it needs no remedy, this waits for the link, which works in spite of it."""
    check: str = ""
    command: str = ""
    signs: tuple[Sign, ...] = ()


@dataclass(slots=True)
class Result:
    """What was said about a mistake. Texts are on one line each."""

    check: str = ""
    command: str = ""
    causes: dict[Side, set[str]] = field(default_factory=lambda: {"here": set(), "there": set()})
    logged: dict[Side, set[str]] = field(default_factory=lambda: {"here": set(), "there": set()})
    shown: list[Sign] = field(default_factory=list)
    problem: str = ""
    """Why the mistake could not be made, or what was missing."""


def is_in(pattern: str, text: str) -> bool:
    """Whether the essential words are in a text."""
    return re.search(pattern, text) is not None
