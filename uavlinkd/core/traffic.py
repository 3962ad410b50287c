"""What went over the wire with one peer, in numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from uavlinkd.core.drops import DropReason


@dataclass(slots=True)
class Traffic:
    """Counters that only grow, as long as the daemon runs."""

    datagrams_sent: int = 0
    """Envelopes and handshake messages; ``bytes_sent`` are theirs."""
    bytes_sent: int = 0
    bytes_elsewhere: int = 0
    """Of answers and path challenges to places where the peer is not known to be. Whoever replays its handshakes or
    its envelopes causes them: they are no part of ``bytes_sent``, from which a link's budget is reckoned."""
    envelopes_sent: int = 0
    envelopes_received: int = 0
    bytes_received: int = 0
    """Of the envelopes."""
    handshakes: int = 0
    drops: Counter[DropReason] = field(default_factory=Counter)
    missing: int = 0
    """Envelopes of sessions that have ended, sent by the peer and never accepted here."""
    out_of_order: int = 0
    """Envelopes accepted after one that was sent later."""
    challenges_unanswered: int = 0
    """Paths from which the peer's envelopes came, and where nobody proved to be the peer."""
    echoes_unanswered: int = 0
    """Own echo requests to which nothing came within what is late."""
    handshakes_unanswered: int = 0
    """Initiations on a link that is up to which no response came before the next try."""
    cookies_taken: int = 0
    """Cookies of a peer under load. Who knows both public keys can make them too."""
    reported: tuple[int, int] = (0, 0)
    """Of the current session, as the peer last reported: envelopes expected there, and received."""
