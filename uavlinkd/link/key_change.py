"""Key changes: meanwhile a peer may have either key, and may know either of ours.

The core then has the peer once for each pair of keys that may be right, by different names. The pair that both ends
have gets a session, so files with the new keys may arrive in any order. A session with the current pair proves that
the other end has changed its keys too. Then the daemon stops accepting the other pairs for as long as it runs, even
if other changes are reloaded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import inf
from typing import NamedTuple

from uavlinkd.config import PeerConfig
from uavlinkd.core.settings import PeerSettings, previous_of


class KeyPairing(NamedTuple):
    """A pair of keys for a peer of the core: one of the peer's, and one of ours that the peer knows."""

    settings: PeerSettings
    by_their_previous: bool = False
    by_our_previous: bool = False

    @property
    def previous_key(self) -> tuple[str, bytes]:
        """The peer and the previous key that this pair depends on; an empty key for our own."""
        return link_name(self.settings.name), b"" if self.by_our_previous else self.settings.public_key


def pairings(peer: PeerConfig, has_previous_key: bool) -> list[KeyPairing]:
    """The pairs of keys that may be right. The current one is first."""
    current = peer.settings
    pairs = [KeyPairing(current)]
    if peer.previous_public_key is not None:
        pairs.append(KeyPairing(previous_of(current, peer.previous_public_key), by_their_previous=True))
    if has_previous_key:
        for settings, by_their_previous, _ in tuple(pairs):
            ours = replace(settings, name=f"{settings.name} (our previous key)")
            pairs.append(KeyPairing(ours, by_their_previous, by_our_previous=True))
    return pairs


class Graces:
    """The times until which pairs with a previous key are valid. A link that is created again gets no second grace.

    There is one time for a peer's previous key, and one for ours with each peer, for both keys of that peer.
    """

    def __init__(self) -> None:
        self._until: dict[tuple[str, bytes], float] = {}  # by KeyPairing.previous_key

    def until(self, pairing: KeyPairing, now: float, grace_s: float) -> float:
        """When a pair's grace ends. It begins with the first call for this pair."""
        return self._until.setdefault(pairing.previous_key, now + grace_s)

    def end(self, pairing: KeyPairing) -> None:
        """The pair is no longer accepted."""
        self._until[pairing.previous_key] = -inf

    def follow(self, before: Iterable[PeerConfig], after: Iterable[PeerConfig]) -> None:
        """A new configuration. A previous key that was removed from it gets a new grace if it is added again."""
        removed = {peer.previous_public_key for peer in before} - {peer.previous_public_key for peer in after}
        self._until = {key: until for key, until in self._until.items() if key[1] not in removed}


def link_name(core_name: str) -> str:
    """The peer as the configuration names it, of a pair's name: names in a configuration have no spaces."""
    return core_name.partition(" ")[0]
