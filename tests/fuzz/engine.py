"""Fuzz targets, how they read their bytes, and a mutator with a seed.

A target is a function of bytes: the same bytes cause the same run. It asserts properties that hold for any bytes.

The mutator is our own although Atheris (libFuzzer) has one: Atheris has wheels for x86-64 only, and every test run
needs the same inputs from the same seed.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from math import inf
from typing import Final, NamedTuple, Protocol

Run = Callable[[bytes], None]
"""Runs one script. Raises if a property does not hold; returns nothing."""


@dataclass(frozen=True, slots=True)
class Target:
    """One entry point, and the assertions about it."""

    name: str
    about: str
    make: Callable[[], Run]
    """Creates the stage; returns a function that runs one input."""
    max_bytes: int = 2048
    words: tuple[bytes, ...] = ()
    """Words to insert."""
    is_text: bool = False
    """Whether arbitrary bytes are refused immediately: then only variations of known inputs are tried."""
    shipped: Callable[[], list[bytes]] = list
    """Files of the repository to start with, beside the kept corpus."""


class Script:
    """Bytes read as numbers and pieces. It never fails: behind the end every byte is zero."""

    __slots__ = ("at", "data", "size")

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.size = len(data)
        self.at = 0

    def __bool__(self) -> bool:
        return self.at < self.size

    def byte(self) -> int:
        """0 to 255."""
        at = self.at
        self.at = at + 1
        return self.data[at] if at < self.size else 0

    def word(self) -> int:
        """0 to 65535."""
        at = self.at
        self.at = at + 2
        return int.from_bytes(self.data[at : at + 2], "big")

    def long(self) -> int:
        """0 to 2**32 - 1."""
        at = self.at
        self.at = at + 4
        return int.from_bytes(self.data[at : at + 4], "big")

    def take(self, size: int) -> bytes:
        """The next ``size`` bytes, or as many as are left."""
        at = self.at
        self.at = at + size
        return self.data[at : at + size]


class Actor(Protocol):
    """A hostile peer or member with its victim: a script decides what it does."""

    def step(self, script: Script) -> None:
        """One action."""

    def check_bounds(self) -> None:
        """No table is larger than it may be."""

    def check_sequel(self) -> None:
        """Whatever was before, an honest exchange works."""


CHECKS_THE_SEQUEL: Final = 0xE0
"""Set in the first byte of an actor's script: then the sequel is checked at its end."""


def play(actors: Sequence[Callable[[], Actor]]) -> Run:
    """A run by one of these actors, which the first byte chooses."""

    def run(data: bytes) -> None:
        script = Script(data)
        first = script.byte()
        actor = actors[first % len(actors)]()
        while script:
            actor.step(script)
            actor.check_bounds()
        if first & CHECKS_THE_SEQUEL == CHECKS_THE_SEQUEL:
            actor.check_sequel()

    return run


# A hunt without a fuzzer.


def variations(seeds: Sequence[bytes], seed: int, target: Target) -> Iterator[bytes]:
    """Yield inputs indefinitely, the same for the same seed: mutated seeds, and random bytes unless a target is text.

    No coverage guides them, so they cost less than those of a fuzzer.
    """
    rng = random.Random(seed)
    known = [seed_input for seed_input in seeds if seed_input] or [b"\0"]
    while True:
        if not target.is_text and rng.random() < 0.8:
            yield rng.randbytes(rng.choice((target.max_bytes, rng.randint(1, target.max_bytes))))
            continue
        data = bytearray(rng.choice(known))
        for _ in range(1 << rng.randrange(3 if target.is_text else 5)):
            (_vary_text if target.is_text else _vary)(data, known, rng, target.words)
        yield bytes(data[: target.max_bytes])


def _vary(data: bytearray, known: Sequence[bytes], rng: random.Random, words: tuple[bytes, ...]) -> None:
    size = len(data)
    at = rng.randrange(size + 1)
    match rng.randrange(8):
        case 0 if at < size:
            data[at] ^= 1 << rng.randrange(8)
        case 1 if at < size:
            data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        case 2:
            data[at:at] = rng.randbytes(rng.randint(1, 16))
        case 3:
            del data[at : at + rng.randint(1, 16)]
        case 4:
            length = rng.randint(1, 32)
            to = rng.randrange(size + 1)
            data[to:to] = data[at : at + length]
        case 5:
            other = rng.choice(known)
            start = rng.randrange(len(other))
            data[at : at + rng.randint(0, 32)] = other[start : start + rng.randint(1, 64)]
        case 6 if words:
            data[at : at + rng.randint(0, 8)] = rng.choice(words)
        case _:
            data[at : at + 4] = rng.randbytes(4)


def _vary_text(data: bytearray, known: Sequence[bytes], rng: random.Random, words: tuple[bytes, ...]) -> None:
    """Vary lines, values and printable characters: most results are still text of the same kind."""
    lines = bytes(data).split(b"\n")
    number = rng.randrange(len(lines))
    line = lines[number]
    at = rng.randrange(len(line) + 1)
    match rng.randrange(7):
        case 0:
            del lines[number]
        case 1:
            lines.insert(rng.randrange(len(lines) + 1), line)
        case 2:
            lines.insert(number, rng.choice(rng.choice(known).split(b"\n")))
        case 3 if b"=" in line:
            lines[number] = line.partition(b"=")[0] + b"= " + rng.choice(words)
        case 4:
            lines[number] = line[:at] + rng.choice(words) + line[at:]
        case 5:
            lines[number] = line[:at] + line[at + rng.randint(1, 4) :]
        case _:
            lines[number] = line[:at] + bytes((rng.randrange(0x20, 0x7F),)) + line[at + 1 :]
    data[:] = b"\n".join(lines)


class Hunt(NamedTuple):
    """The result of a hunt."""

    executions: int
    escape: Exception | None = None
    script: bytes = b""
    """The script that escaped."""


def hunt(target: Target, *, kept: Sequence[bytes], seed: int = 0, runs: float = inf, seconds: float = inf) -> Hunt:
    """Run the kept inputs and then variations of them until a script escapes, or the runs or the time are used up."""
    run = target.make()
    ends_at = time.monotonic() + seconds
    known = [*target.shipped(), *kept]
    executions = 0
    for data in chain(known, variations(known, seed, target)):
        if executions == runs or time.monotonic() >= ends_at:
            break
        executions += 1
        try:
            run(data)
        except Exception as error:  # whatever escapes is what is looked for
            return Hunt(executions, error, data)
    return Hunt(executions)
