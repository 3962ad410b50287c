"""Which peer by certificate gives way to a new one."""

from __future__ import annotations

from collections.abc import Container, Iterable

from uavlinkd.core.peer import Peer


def longest_down(peers: Iterable[Peer], kept: Container[bytes] = ()) -> Peer | None:
    """Of the peers by certificate that are down, the one that was last seen first; None if all are up or ``kept``."""
    down = (
        peer
        for peer in peers
        if peer.settings.is_certified and not peer.is_up and peer.settings.public_key not in kept
    )
    return min(down, key=_seen_at, default=None)


def _seen_at(peer: Peer) -> float:
    """When something new came from it; of a peer that was never up, when it was added."""
    return peer.sent_at if peer.received_at is None else peer.received_at
