"""Fuzz targets, how they read their bytes, and a mutator with a seed.

A target is a function of bytes: the same bytes cause the same run. It asserts properties that hold for any bytes.
:data:`TALLY` counts the inputs that it offered to the entry point: one input of a fuzzer is a script of many
datagrams.

The mutator is our own although Atheris (libFuzzer) has one: Atheris has wheels for x86-64 only, and every test run
needs the same inputs from the same seed.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

Run = Callable[[bytes], None]
"""Runs one script. Raises if a property does not hold; returns nothing."""

SAMPLE: Final = 256
"""One of so many inputs is remembered by its hash, to estimate the number of different inputs."""


class Tally:
    """The number of inputs to an entry point, and an estimate of the number of different ones."""

    __slots__ = ("_sampled", "offered")

    def __init__(self) -> None:
        self.offered = 0
        self._sampled: set[int] = set()

    def add(self, data: bytes) -> None:
        """Count one more."""
        self.offered += 1
        number = hash(data)
        if number % SAMPLE == 0:
            self._sampled.add(number)

    @property
    def distinct(self) -> int:
        """The number of different inputs, within a few per cent for large numbers."""
        return min(self.offered, len(self._sampled) * SAMPLE)

    def clear(self) -> None:
        """Start from zero."""
        self.offered = 0
        self._sampled.clear()


TALLY: Final = Tally()
"""The tally of this process, which runs one target."""


@dataclass(frozen=True, slots=True)
class Target:
    """One entry point, and the assertions about it."""

    name: str
    about: str
    make: Callable[[], Run]
    """Creates the stage; returns a function that runs one input."""
    seeds: Callable[[], list[bytes]]
    """Inputs to start with, in addition to the kept corpus."""
    max_bytes: int = 2048
    words: tuple[bytes, ...] = ()
    """Words to insert."""
    is_text: bool = False
    """Whether arbitrary bytes are refused immediately: then only variations of known inputs are tried."""


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
    seconds: float
    escape: Exception | None = None
    script: bytes = b""
    """The script that escaped."""


def hunt(
    target: Target,
    *,
    seeds: Sequence[bytes] = (),
    seed: int = 0,
    runs: int | None = None,
    seconds: float | None = None,
    on_progress: Callable[[int], None] = lambda executions: None,
) -> Hunt:
    """Run the seeds and then variations of them until a script escapes, or the runs or the time are used up."""
    run = target.make()
    started = time.monotonic()
    known = [*target.seeds(), *seeds]
    executions = 0
    for data in _chain(known, variations(known, seed, target)):
        if executions == runs or (seconds is not None and time.monotonic() - started >= seconds):
            break
        executions += 1
        try:
            run(data)
        except Exception as error:  # whatever escapes is what is looked for
            return Hunt(executions, time.monotonic() - started, error, data)
        on_progress(executions)
    return Hunt(executions, time.monotonic() - started)


def _chain(first: Sequence[bytes], then: Iterator[bytes]) -> Iterator[bytes]:
    yield from first
    yield from then
