"""What tells the paths to a peer apart on a screen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

_DETAILS: Final = {"relay_address": "at", "number": "path"}
"""Facts of a relayed path, and the word before each. Two paths along one port of a relay lead to two addresses of the
peer. Only the relay knows these, so the number of the path has to do."""


def addresses(paths: Sequence[Mapping[str, Any]]) -> list[str]:
    """The address of each path. Relayed paths that look alike have the relay's address too, or else their number."""
    names = [path["address"] for path in paths]
    for fact, word in _DETAILS.items():
        times = Counter((path["network"], name) for path, name in zip(paths, names, strict=True))
        for at, path in enumerate(paths):
            if path["relay"] is not None and times[path["network"], names[at]] > 1 and path.get(fact) is not None:
                names[at] += f" {word} {path[fact]}"
    return names
