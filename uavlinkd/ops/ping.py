"""``uavlinkd ping``: which paths to a peer answer, how fast, and which of them frames use."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from uavlinkd.ops.status_screen import addresses
from uavlinkd.system.terminal import printable

INTERVAL_S: Final = 1.0
"""Between questions."""

ANSWERED_S: Final = 1.5 * INTERVAL_S
"""A younger answer is one to the last question, which is an interval old; an older one is not."""

Answer = Mapping[str, Any]


def ping(ask: Callable[[], Answer], count: int, write: Callable[[str], None], sleep: Callable[[float], None]) -> bool:
    """Ask along every path ``count`` times, a second apart, and write a line for each answer that came or did not.

    ``ask`` sends the questions, and returns the paths as they were before. Returns whether the last question was
    answered along any path.
    """
    ask()
    answered = False
    for number in range(1, count + 1):
        sleep(INTERVAL_S)
        answer = ask()  # also the next questions
        answered = False
        for path, address in zip(answer["paths"], addresses(answer["paths"]), strict=True):
            answered |= is_answered(path)
            write(printable(f"{number}: {describe(path, address)}"))
        if not answer["paths"]:
            write(
                f"{number}: no path is known: the peer has not connected, or no relay has bound it;"
                " `uavlinkd status` names the cause"
            )
    return answered


def is_answered(path: Answer) -> bool:
    """Whether the last question was answered along a path."""
    return path["answered_s"] is not None and path["answered_s"] < ANSWERED_S


def describe(path: Answer, address: str) -> str:
    """A path in one line."""
    return ", ".join(_facts(path, address))


def _facts(path: Answer, address: str) -> Iterator[str]:
    where = address if path["relay"] is not None else f"direct to {address}"
    yield f"{where} on {path['network']}" if path["network"] else where
    if is_answered(path):
        yield f"{1000 * path['round_trip_s']:.1f} ms"
    else:
        yield "no answer"
    yield f"loss {100 * path['loss_in']:.0f} % in, {100 * path['loss_out']:.0f} % out"
    yield f"carries {' and '.join(path['carries'])}" if path["carries"] else "carries no frames"


def run(ask: Callable[[], Answer], count: int) -> bool:
    """Ping on this terminal."""
    return ping(ask, count, lambda line: print(line, flush=True), time.sleep)
