"""``python -m tests.fuzz``: libFuzzer (atheris) drives the targets, guided by coverage, each in its own process.

    python -m tests.fuzz --list
    python -m tests.fuzz                                       every target for a minute
    python -m tests.fuzz session sealed -max_total_time=3600   these, with options of libFuzzer
    python -m tests.fuzz idle --keep                           and add new inputs to the kept corpus
    python -m tests.fuzz key --replay escape-key-crash-0123    one input again, in this process

Exit status 1: a script escaped. The output names the file with its input.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.fuzz import corpus
from tests.fuzz.registry import TARGETS
from uavlinkd.lab.child_processes import end_with_parent

ROOT: Final = Path(__file__).resolve().parents[2]
A_MINUTE: Final = ("-max_total_time=60",)


def fuzz(name: str, options: Sequence[str], *, plant: str = "", keeps: bool = False) -> str:
    """Fuzz one target in its own process, from the kept corpus. The output if a script escaped, otherwise "".

    ``options``: libFuzzer's. ``plant``: the name of a planted fault. ``keeps``: new inputs go to the kept corpus.
    """
    target = TARGETS[name]
    with tempfile.TemporaryDirectory(prefix=f"uavlinkd-fuzz-{name}-") as scratch:
        folder = Path(scratch) / "corpus"
        folder.mkdir()
        for number, data in enumerate([*target.shipped(), *corpus.load(name)]):
            (folder / f"{number:05d}").write_bytes(data)
        lines = ["".join(f"\\x{byte:02x}" for byte in word) for word in target.words]
        (Path(scratch) / "words").write_text("".join(f'"{line}"\n' for line in lines))
        process = subprocess.run(
            end_with_parent(
                *(sys.executable, "-m", "tests.fuzz.worker", name, plant, f"-max_len={target.max_bytes}"),
                *("-len_control=0", "-timeout=30", "-rss_limit_mb=2048", f"-artifact_prefix=escape-{name}-"),
                *([f"-dict={scratch}/words"] if target.words else []),
                *(*options, str(folder)),
            ),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
            # libFuzzer ends the process without cleanup: its files are deleted with the scratch folder.
            env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "0", "TMPDIR": scratch},
        )
        if keeps and not process.returncode:
            corpus.save(name, [*corpus.load(name), *(path.read_bytes() for path in folder.iterdir())])
        print(f"{name:<11} {process.stdout.splitlines()[-1]}", flush=True)
        return process.stdout if process.returncode else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Fuzz the entry points of uavlinkd.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all")
    parser.add_argument("--list", action="store_true", help="list the targets with their descriptions")
    parser.add_argument("--keep", action="store_true", help="add new inputs to the kept corpus")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run one input of one target, in this process")
    given, options = parser.parse_known_args(arguments)
    if unknown := [name for name in given.targets if name not in TARGETS]:
        parser.error(f"no target {', '.join(unknown)}: see --list")
    names = given.targets or list(TARGETS)
    if given.list:
        print("\n".join(f"{name:<11} {TARGETS[name].about}" for name in names))
    elif given.replay:
        TARGETS[names[0]].make()(given.replay.read_bytes())
    else:
        escapes = [output for name in names if (output := fuzz(name, options or A_MINUTE, keeps=given.keep))]
        print("\n".join(escapes))
        return 1 if escapes else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
