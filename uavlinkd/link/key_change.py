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
    by_their_previous: bool = False
    by_our_previous: bool = False

    @property
    def previous_key(self) -> tuple[str, bytes]:
        """The peer and the previous key that this pair stands or falls with: nothing where that is ours."""
        return link_name(self.settings.name), b"" if self.by_our_previous else self.settings.public_key


def pairings(peer: Peer, has_previous_key: bool) -> list[KeyPairing]:
    """The pairs of keys that may be right, the current one first."""
    current = peer.settings
    found = [KeyPairing(current)]
    if peer.previous_public_key is not None:
        theirs = replace(current, name=f"{peer.name} (previous key)", public_key=peer.previous_public_key)
        found.append(KeyPairing(theirs, by_their_previous=True))
    if has_previous_key:
        for settings, by_their_previous, _ in tuple(found):
            ours = replace(settings, name=f"{settings.name} (our previous key)")
            found.append(KeyPairing(ours, by_their_previous, by_our_previous=True))
    return found


class Graces:
    """Until when pairs with a previous key are good: a link that is made anew does not get a second grace.

    A peer's previous key has one, and so has ours with each peer, whichever key that peer has by then.
    """

    def __init__(self) -> None:
        self._until: dict[tuple[str, bytes], float] = {}  # by KeyPairing.previous_key

    def until(self, pairing: KeyPairing, now: float, grace_s: float) -> float:
        """When a pair's grace ends, which begins at the first time that it is asked for."""
        return self._until.setdefault(pairing.previous_key, now + grace_s)

    def end(self, pairing: KeyPairing) -> None:
        """The pair was given up."""
        self._until[pairing.previous_key] = -inf

    def follow(self, before: Iterable[Peer], after: Iterable[Peer]) -> None:
        """A new configuration. Previous keys that were taken out of it are good anew where they are put in again."""
        keys = {each.previous_public_key for each in before} - {each.previous_public_key for each in after}
        self._until = {each: until for each, until in self._until.items() if each[1] not in keys}


def link_name(core_name: str) -> str:
    """The peer as the configuration names it, of a pair's name: names in a configuration have no spaces."""
    return core_name.partition(" ")[0]
