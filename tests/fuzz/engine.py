"""What a fuzz target is, how it reads its bytes, and a hunt by a seeded generator that needs no fuzzer at all.

A target is a function of bytes: the same bytes, the same run. It asserts what must hold for any of them, and says by
:data:`TALLY` how many inputs it has offered to the entry point: one fuzzer's input is a script of many datagrams.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

Run = Callable[[bytes], None]
"""Runs one script. Raises where a property does not hold; returns nothing."""

SAMPLE: Final = 256
"""One input in so many is remembered by its hash, to tell how many were different from one another."""


class Tally:
    """How many inputs went to an entry point, and about how many of them were different."""

    __slots__ = ("_sampled", "offered")

    def __init__(self) -> None:
        self.offered = 0
        self._sampled: set[int] = set()

    def add(self, data: bytes) -> None:
        """One more."""
        self.offered += 1
        number = hash(data)
        if number % SAMPLE == 0:
            self._sampled.add(number)

    @property
    def distinct(self) -> int:
        """How many different ones, to within a few per cent once there are many."""
        return min(self.offered, len(self._sampled) * SAMPLE)

    def clear(self) -> None:
        """Begin anew."""
        self.offered = 0
        self._sampled.clear()


TALLY: Final = Tally()
"""Of this process, which runs one target."""


@dataclass(frozen=True, slots=True)
class Target:
    """One entry point, and what is asserted of it."""

    name: str
    about: str
    make: Callable[[], Run]
    """Sets the stage; what it returns is called for each input."""
    seeds: Callable[[], list[bytes]]
    """Inputs to begin with, beside the kept corpus."""
    max_bytes: int = 2048
    words: tuple[bytes, ...] = ()
    """What is worth inserting."""
    is_text: bool = False
    """Whether arbitrary bytes are refused at the door: then only variations of what is known are tried."""


class Script:
    """Bytes read as numbers and pieces. Total: past the end everything is zero."""

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

    def take(self, amount: int) -> bytes:
        """So many bytes, or as many as are left."""
        at = self.at
        self.at = at + amount
        return self.data[at : at + amount]


# A hunt without a fuzzer.


def variations(seeds: Sequence[bytes], seed: int, target: Target) -> Iterator[bytes]:
    """Endless inputs, the same for the same seed: variations of the seeds; where any bytes are a script, new ones.

    No coverage guides them, so they cost less than a fuzzer's, and need nothing.
    """
    chance = random.Random(seed)
    known = [each for each in seeds if each] or [b"\0"]
    while True:
        if not target.is_text and chance.random() < 0.8:
            yield chance.randbytes(chance.choice((target.max_bytes, chance.randint(1, target.max_bytes))))
            continue
        data = bytearray(chance.choice(known))
        for _ in range(1 << chance.randrange(3 if target.is_text else 5)):
            (_vary_text if target.is_text else _vary)(data, known, chance, target.words)
        yield bytes(data[: target.max_bytes])


def _vary(data: bytearray, known: Sequence[bytes], chance: random.Random, words: tuple[bytes, ...]) -> None:
    size = len(data)
    at = chance.randrange(size + 1)
    match chance.randrange(8):
        case 0 if at < size:
            data[at] ^= 1 << chance.randrange(8)
        case 1 if at < size:
            data[at] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))
        case 2:
            data[at:at] = chance.randbytes(chance.randint(1, 16))
        case 3:
            del data[at : at + chance.randint(1, 16)]
        case 4:
            length = chance.randint(1, 32)
            to = chance.randrange(size + 1)
            data[to:to] = data[at : at + length]
        case 5:
            other = chance.choice(known)
            start = chance.randrange(len(other))
            data[at : at + chance.randint(0, 32)] = other[start : start + chance.randint(1, 64)]
        case 6 if words:
            data[at : at + chance.randint(0, 8)] = chance.choice(words)
        case _:
            data[at : at + 4] = chance.randbytes(4)


def _vary_text(data: bytearray, known: Sequence[bytes], chance: random.Random, words: tuple[bytes, ...]) -> None:
    """By lines, values and printable characters: most of what comes is still text of its kind."""
    lines = bytes(data).split(b"\n")
    number = chance.randrange(len(lines))
    line = lines[number]
    at = chance.randrange(len(line) + 1)
    match chance.randrange(7):
        case 0:
            del lines[number]
        case 1:
            lines.insert(chance.randrange(len(lines) + 1), line)
        case 2:
            lines.insert(number, chance.choice(chance.choice(known).split(b"\n")))
        case 3 if b"=" in line:
            lines[number] = line.partition(b"=")[0] + b"= " + chance.choice(words)
        case 4:
            lines[number] = line[:at] + chance.choice(words) + line[at:]
        case 5:
            lines[number] = line[:at] + line[at + chance.randint(1, 4) :]
        case _:
            lines[number] = line[:at] + bytes((chance.randrange(0x20, 0x7F),)) + line[at + 1 :]
    data[:] = b"\n".join(lines)


class Hunt(NamedTuple):
    """How a hunt went."""

    executions: int
    seconds: float
    escape: Exception | None = None
    script: bytes = b""
    """The one that escaped."""


def hunt(
    target: Target,
    *,
    seeds: Sequence[bytes] = (),
    seed: int = 0,
    runs: int | None = None,
    seconds: float | None = None,
    on_progress: Callable[[int], None] = lambda executions: None,
) -> Hunt:
    """Run the seeds, then variations of them, until something escapes, or so many were run, or time is up."""
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
