"""The kept corpus: one text file for each target, one input per line in base64. New inputs can be merged into it."""

from __future__ import annotations

import base64
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any, Final

import uavlinkd

KEPT: Final = Path(__file__).parent / "corpus"
MAX_FILE_BYTES: Final = 20_000
"""Limit of one target's file: the smallest inputs are kept, so all files are below 400 kB."""


def path_of(name: str, folder: Path = KEPT) -> Path:
    """The file of a target."""
    return folder / f"{name}.txt"


def load(name: str, folder: Path = KEPT) -> list[bytes]:
    """The inputs of a target; none without a file."""
    path = path_of(name, folder)
    return [base64.b64decode(line, validate=True) for line in path.read_text().split()] if path.exists() else []


def save(name: str, inputs: Iterable[bytes], folder: Path = KEPT) -> int:
    """Replace the kept inputs, the smallest first, as many as fit; returns their number."""
    lines: list[str] = []
    size = 0
    for data in sorted({data for data in inputs if data}, key=lambda data: (len(data), data)):
        line = base64.b64encode(data).decode() + "\n"
        size += len(line)
        if size > MAX_FILE_BYTES:
            break
        lines.append(line)
    folder.mkdir(parents=True, exist_ok=True)
    path_of(name, folder).write_text("".join(lines))
    return len(lines)


def minimised(run: Callable[[bytes], None], inputs: Iterable[bytes]) -> list[bytes]:
    """The inputs, smallest first, that reach a new pair of consecutive lines of the package."""
    package = str(Path(uavlinkd.__file__).parent)
    known: set[tuple[str, int, int]] = set()
    kept = []
    for data in sorted(inputs, key=lambda data: (len(data), data)):
        steps: set[tuple[str, int, int]] = set()

        def enter(frame: FrameType, event: str, argument: Any, steps: set[tuple[str, int, int]] = steps) -> Any:
            name = frame.f_code.co_filename
            if not name.startswith(package):
                return None
            before = frame.f_code.co_firstlineno

            def step(frame: FrameType, event: str, argument: Any) -> Any:
                nonlocal before
                steps.add((name, before, frame.f_lineno))
                before = frame.f_lineno
                return step

            return step

        sys.settrace(enter)
        try:
            run(data)
        finally:
            sys.settrace(None)
        if not steps <= known:
            known |= steps
            kept.append(data)
    return kept


def unpack(inputs: Iterable[bytes], folder: Path) -> None:
    """Write each input to a file, as libFuzzer expects."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(inputs):
        (folder / f"{number:05d}").write_bytes(data)


def packed(folder: Path) -> list[bytes]:
    """The inputs that libFuzzer wrote to a folder."""
    return [path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()]
