"""A mistake, what is expected of `check`, the logs and `status`, and what they said."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tests.mistakes.scene import Scene

Grade = Literal["exact", "partial", "not needed"]
Before = Literal["yes", "half", "no", "-", "new"]
"""Whether the remedy was shown before `status` had causes; ``-``: none is needed; ``new``: not tried then."""
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
    name: str
    before: Before
    grade: Grade = "exact"
    check: str = ""
    command: str = ""
    signs: tuple[Sign, ...] = ()
    make: Callable[[Scene], Awaitable[None]] | None = None
    is_up: bool = False
    """Whether the link works in spite of the mistake."""


@dataclass(slots=True)
class Result:
    """What was said about a mistake. Texts are on one line each."""

    check: str = ""
    command: str = ""
    causes: dict[Side, set[str]] = field(default_factory=lambda: {"here": set(), "there": set()})
    logged: dict[Side, set[str]] = field(default_factory=lambda: {"here": set(), "there": set()})
    shown: list[Sign] = field(default_factory=list)
    within_s: float = 0.0
    calm_s: float = 0.0
    was_up: bool = False
    problem: str = ""
    """Why the mistake could not be made, or what was missing."""

    def remedy(self, mistake: Mistake) -> str:
        """``exact``: check, command or status name the mistake and what to do. ``partial``: an event without it."""
        if mistake.grade == "not needed":
            return "not needed" if self.was_up or (mistake.check and is_in(mistake.check, self.check)) else "no"
        texts = ((mistake.check, self.check), (mistake.command, self.command))
        if self.shown or any(pattern and is_in(pattern, text) for pattern, text in texts):
            return "exact"
        return "partial" if self.causes["here"] | self.causes["there"] else "no"


def is_in(pattern: str, text: str) -> bool:
    """Whether the essential words are in a text."""
    return re.search(pattern, text) is not None
