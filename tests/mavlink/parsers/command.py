"""The proof by real parsers, at length: generated streams through policy and filter to receivers of the C library.

Prints counts, the coverage of the parsers' steps, and each forbidden frame that a receiver accepted. Exit status 0
if there was not one and every step was covered.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from tests.mavlink.parsers.build import DIALECTS, LIBRARIES, BuildError, build
from tests.mavlink.parsers.judge import filtered, unfiltered
from tests.mavlink.parsers.run import Result, run

OK, FAILED = 0, 1
_CHUNK = 100_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: no forbidden frame was accepted. 1: one was, or steps are missing. 2: invalid command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.parsers", description=__doc__)
    parser.add_argument("--streams", type=int, default=10_000, help="how many streams to try (10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the generated streams")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--share", type=int, default=4, help="one in so many receivers reads a batch, in turn (4)")
    parser.add_argument("--unfiltered", action="store_true", help="by policy alone, without the filter")
    options = parser.parse_args(arguments)
    if min(options.streams, options.jobs, options.share) < 1:
        parser.error("--streams, --jobs and --share are at least 1")
    try:
        for dialect in DIALECTS:
            for library in LIBRARIES:
                build(dialect, library)  # before the processes are made: each has it then
    except BuildError as error:
        print(error, file=sys.stderr)
        return FAILED
    chunks = [min(_CHUNK, options.streams - begin) for begin in range(0, options.streams, _CHUNK)]
    total = Result()
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("fork")) as pool:
        begun = [
            pool.submit(_chunk, count, options.seed * 1_000_000 + number, options.share, options.unfiltered)
            for number, count in enumerate(chunks)
        ]
        for future in begun:
            total.add(future.result())
            print(f"{total.streams:,} streams, {sum(total.breaches_by_receiver.values()):,} forbidden", flush=True)
    print("\n".join(total.lines()))
    is_missing = any(total.missing_steps.values())
    return FAILED if total.breaches_by_receiver or total.verdicts.truncated or is_missing else OK


def _chunk(streams: int, seed: int, share: int, is_unfiltered: bool) -> Result:
    return run(streams, seed, share=share, make=unfiltered if is_unfiltered else filtered)
