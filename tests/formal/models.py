"""The symbolic models of the protocol: assembled, run by ProVerif, and read.

A model is a ``.pv`` file beside this one: queries and the process. Its header names the ingredients of
``uavlink.pvl`` that it uses. A comment before each query is ProVerif's expected result. By hand::

    python -m tests.formal.models              every model: one line for each query, as ProVerif printed it
    python -m tests.formal.models forward kem  those whose name contains one of these
    python -m tests.formal.models --text NAME  the complete text of a model, to read or to pass to ProVerif
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

FOLDER = Path(__file__).parent
PROTOCOL = FOLDER / "uavlink.pvl"
LIMIT_S = 600.0

_MARKED = re.compile(r"\(\*([+-])(\w+)\*\)")
_USES = re.compile(r"\(\* uses: ([\w\s]*?) \*\)")
_EXPECT = re.compile(r"^\(\* expect: (true|false|cannot be proved) \*\)$", re.MULTILINE)
_RESULT = re.compile(r"^ *RESULT (?!\((?:but|even) ).*?(is true|is false|cannot be proved)\b.*$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Run:
    """ProVerif's result for one model."""

    results: tuple[str, ...]
    """One for each query in the order of the file: ``true``, ``false``, ``cannot be proved``."""
    lines: tuple[str, ...]
    """The ``RESULT`` lines as printed."""
    cpu_s: float


def proverif() -> str | None:
    """The ProVerif executable: environment variable ``PROVERIF``, else on the PATH."""
    return os.environ.get("PROVERIF") or shutil.which("proverif")


def models() -> list[Path]:
    """Every model, by name."""
    return sorted(FOLDER.glob("*.pv"))


def expected(model: Path) -> tuple[str, ...]:
    """The expected result of each query, which the model contains."""
    return tuple(_EXPECT.findall(model.read_text()))


def ingredients(model: Path) -> frozenset[str] | None:
    """The ingredients of the protocol that the model uses; None if it is complete in itself."""
    uses = _USES.search(model.read_text())
    return frozenset(uses[1].split()) if uses else None


def known_ingredients() -> frozenset[str]:
    """The ingredients that the protocol's text names."""
    return frozenset(name for _, name in _MARKED.findall(PROTOCOL.read_text()))


def select(uses: frozenset[str]) -> str:
    """The protocol with only these ingredients."""
    return "".join(
        line
        for line in PROTOCOL.read_text().splitlines(keepends=True)
        if not (marked := _MARKED.match(line)) or (marked[2] in uses) == (marked[1] == "+")
    )


def assemble(model: Path) -> str:
    """The model's complete text."""
    uses = ingredients(model)
    return model.read_text() if uses is None else select(uses) + "\n" + model.read_text()


def results(output: str) -> tuple[str, ...]:
    """``true``, ``false`` or ``cannot be proved`` for each query, from ProVerif's output."""
    return tuple(match[1].removeprefix("is ") for match in _RESULT.finditer(output))


def run(model: Path, executable: str, limit_s: float = LIMIT_S) -> Run:
    """Run ProVerif on a model.

    Raises:
        subprocess.TimeoutExpired: after ``limit_s`` seconds.
        ValueError: ProVerif refused the model; its message.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder) / model.name
        file.write_text(assemble(model))
        before = _children_cpu_s()
        done = subprocess.run(
            [executable, str(file)],
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        cpu_s = _children_cpu_s() - before
    if done.returncode:
        raise ValueError(f"{model.name}: {(done.stdout + done.stderr)[-2000:]}")
    lines = tuple(match[0] for match in _RESULT.finditer(done.stdout))
    return Run(results(done.stdout), lines, cpu_s)


def _children_cpu_s() -> float:
    times = os.times()
    return times.children_user + times.children_system


def main(arguments: list[str]) -> int:
    """Print the requested results; returns 1 if one is not as expected."""
    if arguments[:1] == ["--text"]:
        sys.stdout.write(assemble(FOLDER / f"{arguments[1]}.pv"))
        return 0
    executable = proverif()
    if executable is None:
        sys.stderr.write("proverif is not on the PATH; or set PROVERIF\n")
        return 2
    is_good = True
    for model in models():
        if arguments and not any(part in model.stem for part in arguments):
            continue
        started = time.monotonic()
        try:
            done = run(model, executable)
        except (subprocess.TimeoutExpired, ValueError) as error:
            sys.stdout.write(f"{model.stem}: {error}\n")
            is_good = False
            continue
        agrees = done.results == expected(model)
        is_good &= agrees
        verdict = "as expected" if agrees else f"EXPECTED {', '.join(expected(model))}"
        sys.stdout.write(f"{model.stem}: {done.cpu_s:.1f} s CPU, {time.monotonic() - started:.1f} s, {verdict}\n")
        sys.stdout.writelines(f"    {line}\n" for line in done.lines)
        sys.stdout.flush()
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
