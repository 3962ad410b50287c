"""While a daemon's key changes, a peer may have either key, and may know either of ours.

The core then has the peer once for each pair of keys that may be right, by different names. Whichever pair both ends
hold makes a session, so files with the new keys may arrive in any order. A session of the current pair is the proof
that the other end has changed as well: the other pairs are given up then, for as long as the daemon runs, whatever
else is reloaded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import inf
from typing import NamedTuple

from uavlinkd.config import Peer
from uavlinkd.core.settings import PeerSettings


class KeyPairing(NamedTuple):
    """A peer of the core: with which key of theirs, and by which of ours it knows us."""

    settings: PeerSettings
    by_our_previous: bool = False


def pairings(peer: Peer, has_previous_key: bool) -> list[KeyPairing]:
    """The pairs of keys that may be right, the current one first."""
    current = peer.settings
    found = [KeyPairing(current)]
    if peer.previous_public_key is not None:
        found.append(KeyPairing(replace(current, name=f"{peer.name} {_THEIRS}", public_key=peer.previous_public_key)))
    if has_previous_key:
        found += [
            KeyPairing(replace(each.settings, name=f"{each.settings.name} {_OURS}"), by_our_previous=True)
            for each in found
        ]
    return found


class Graces:
    """Until when pairs with a previous key are good: a link that is made anew does not get a second grace.

    A peer's previous key has one, and so has ours with each peer, whichever key that peer has by then.
    """

    def __init__(self) -> None:
        self._until: dict[tuple[str, bytes], float] = {}  # by peer, and its previous key, or nothing for ours

    def until(self, settings: PeerSettings, now: float, grace_s: float) -> float:
        """When a pair's grace ends, which begins at the first time that it is asked for."""
        return self._until.setdefault(_whose(settings), now + grace_s)

    def end(self, settings: PeerSettings) -> None:
        """The pair was given up."""
        self._until[_whose(settings)] = -inf

    def follow(self, before: Iterable[Peer], after: Iterable[Peer]) -> None:
        """A new configuration. Previous keys that were taken out of it are good anew where they are put in again."""
        keys = {each.previous_public_key for each in before} - {each.previous_public_key for each in after}
        self._until = {each: until for each, until in self._until.items() if each[1] not in keys}


_THEIRS, _OURS = "(previous key)", "(our previous key)"


def is_by_our_previous(core_name: str) -> bool:
    """Whether that peer of the core knows us by our previous key."""
    return core_name.endswith(_OURS)


def is_by_their_previous(core_name: str) -> bool:
    """Whether we know that peer of the core by its previous key."""
    return f" {_THEIRS}" in core_name


def _whose(settings: PeerSettings) -> tuple[str, bytes]:
    """Which previous key a pair stands or falls with."""
    return link_name(settings.name), b"" if is_by_our_previous(settings.name) else settings.public_key


def link_name(core_name: str) -> str:
    """The peer as the configuration names it: names have no spaces."""
    return core_name.partition(" ")[0]
