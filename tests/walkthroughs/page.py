"""The blocks of a walk-through: what a reader types or saves, and on which machine."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).parents[2] / "configs/README.md"
_BLOCK = re.compile(r"^```(sh|toml)\n# (?:(\S+) )?on (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_OTHER_BLOCK = re.compile(r"^```(?:sh|toml)\n(?!# (?:\S+ )?on \S+\n)", re.MULTILINE)
PLACEHOLDER = re.compile(r"PUBLIC-KEY-OF-([\w-]+)")


class Block(NamedTuple):
    """Commands for a machine, or the text of a file."""

    host: str
    file: str
    """The file's name; empty for commands."""
    text: str

    @property
    def commands(self) -> list[str]:
        return self.text.splitlines()


def sections() -> dict[str, list[Block]]:
    """The blocks of each numbered section, in the order in which a reader follows them."""
    parts = re.split(r"^## (\d+ .*)$", PAGE.read_text(), flags=re.MULTILINE)
    return {title: list(_blocks(text)) for title, text in zip(parts[1::2], parts[2::2], strict=True)}


def _blocks(text: str) -> Iterator[Block]:
    assert not _OTHER_BLOCK.search(text), "a block does not name its machine"
    for kind, file, host, body in _BLOCK.findall(text):
        assert (kind == "toml") == bool(file), f"a block on {host}: {body[:40]}"
        yield Block(host, file, body)
