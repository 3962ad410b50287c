"""The problems of an invalid configuration."""

from __future__ import annotations

from typing import NamedTuple


class Problem(NamedTuple):
    """One problem: its file, its key (empty: the file itself), what is wrong and what to do."""

    file: str
    key: str
    message: str

    def __str__(self) -> str:
        return ": ".join(part for part in self if part)


class ConfigError(Exception):
    """Every problem of a file. ``str()`` has one line for each."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        super().__init__(problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(map(str, self.problems))
