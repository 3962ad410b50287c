"""What a mistyped word means: of a command line, a configuration or a policy."""

from __future__ import annotations

from collections.abc import Iterable


def meant(word: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The known word that is most similar, in capitals or small letters; empty if none is."""
    from difflib import get_close_matches  # noqa: PLC0415  a daemon with a right file starts without it

    by_small = {name.lower(): name for name in known}
    close = get_close_matches(word.lower(), by_small, n=1, cutoff=cutoff)
    return by_small[close[0]] if close else ""
