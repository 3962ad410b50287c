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
    """Of responses to addresses where the peer is not known to be. An attacker that replays its handshakes causes
    them, so ``bytes_sent``, which a link's budget pays for, does not include them."""
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
    paths_unproven: int = 0
    """Addresses from which the peer's envelopes came, and from which no question was answered."""
    echoes_unanswered: int = 0
    """Own echo requests without an answer in time."""
    handshakes_unanswered: int = 0
    """Initiations on a link that is up, without a response before the next try."""
    cookies_taken: int = 0
    """Cookies of a peer under load. An attacker that knows both public keys can make them too."""
    reported: tuple[int, int] = (0, 0)
    """Of the current session, as the peer last reported: envelopes expected there, and received."""
