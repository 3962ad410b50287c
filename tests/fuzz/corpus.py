"""The kept corpus: one text file for each target, one input per line in base64. New inputs can be merged into it."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import Final

KEPT: Final = Path(__file__).parent / "corpus"
MAX_FILE_BYTES: Final = 30_000
"""Limit of one target's file: the smallest inputs are kept, so all files are below 400 kB."""


def load(name: str, folder: Path = KEPT) -> list[bytes]:
    """The inputs of a target; none without a file."""
    path = folder / f"{name}.txt"
    return [base64.b64decode(line, validate=True) for line in path.read_text().split()] if path.exists() else []


def save(name: str, inputs: Iterable[bytes], folder: Path = KEPT) -> None:
    """Replace the kept inputs, the smallest first, as many as fit."""
    lines: list[str] = []
    size = 0
    for data in sorted({data for data in inputs if data}, key=lambda data: (len(data), data)):
        line = base64.b64encode(data).decode() + "\n"
        size += len(line)
        if size > MAX_FILE_BYTES:
            break
        lines.append(line)
    (folder / f"{name}.txt").write_text("".join(lines))
