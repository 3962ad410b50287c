"""One target in a process of its own: ``python -m tests.fuzz.worker TARGET ENGINE PROGRESS [ARGUMENT ...]``.

The engine is ``atheris``, which libFuzzer's arguments are handed to, ``seeded``, or ``replay``, which runs the seeds
and the kept corpus once. Numbers go to a small file that the command reads, also when this process ends abruptly.
"""

from __future__ import annotations

import mmap
import struct
import sys
import traceback
from pathlib import Path
from typing import Final

PROGRESS: Final = struct.Struct("<QQQ")
"""Scripts run, inputs sent, and an estimate of the different ones."""
ESCAPED: Final = 77
"""Exit code, as libFuzzer's."""


def _board(path: str) -> mmap.mmap:
    with Path(path).open("r+b") as file:
        return mmap.mmap(file.fileno(), PROGRESS.size)


def _plant(name: str) -> None:
    from tests.fuzz.plants import PLANTS

    PLANTS[name].put()


def fuzz_with_atheris(name: str, board: mmap.mmap, arguments: list[str], plant: str | None) -> None:
    """Run the target in libFuzzer. Does not return."""
    import atheris

    with atheris.instrument_imports(include=["uavlinkd"]):
        from tests.fuzz.registry import TARGETS
    from tests.fuzz.engine import TALLY

    if plant is not None:
        _plant(plant)
    run = TARGETS[name].make()
    executions = 0

    def one(data: bytes) -> None:
        nonlocal executions
        executions += 1
        run(data)
        PROGRESS.pack_into(board, 0, executions, TALLY.offered, TALLY.distinct)

    atheris.Setup([sys.argv[0], *arguments], one)
    atheris.Fuzz()


def fuzz_seeded(name: str, board: mmap.mmap, arguments: list[str]) -> None:
    """A hunt by the seeded generator: ``SEED SECONDS|- RUNS|- FOLDER``."""
    from tests.fuzz import corpus
    from tests.fuzz.engine import TALLY, hunt
    from tests.fuzz.registry import TARGETS

    seed, seconds, runs, folder = arguments
    result = hunt(
        TARGETS[name],
        seeds=corpus.packed(Path(folder)),
        seed=int(seed),
        seconds=None if seconds == "-" else float(seconds),
        runs=None if runs == "-" else int(runs),
        on_progress=lambda executions: PROGRESS.pack_into(board, 0, executions, TALLY.offered, TALLY.distinct),
    )
    if result.escape is not None:
        traceback.print_exception(result.escape)
        (Path(folder).parent / "crash-seeded").write_bytes(result.script)
        sys.exit(ESCAPED)


def replay(name: str) -> int:
    """Run a target's seeds and its kept corpus; returns their number.

    Raises:
        Exception: what escaped.
    """
    from tests.fuzz import corpus
    from tests.fuzz.registry import TARGETS

    target = TARGETS[name]
    run = target.make()
    inputs = [*target.seeds(), *corpus.load(name)]
    for data in inputs:
        run(data)
    return len(inputs)


def main() -> None:
    """The entry point of the process."""
    name, engine, progress, *arguments = sys.argv[1:]
    board = _board(progress)
    plant = None
    if arguments and arguments[0].startswith("plant="):
        plant = arguments.pop(0).removeprefix("plant=")
    if engine == "atheris":
        fuzz_with_atheris(name, board, arguments, plant)
    elif engine == "seeded":
        if plant is not None:
            _plant(plant)
        fuzz_seeded(name, board, arguments)
    else:
        replay(name)


if __name__ == "__main__":
    main()
