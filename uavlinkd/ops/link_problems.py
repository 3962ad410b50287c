"""Problems of a link that no single datagram causes: their names in status, metrics and log, and their meanings."""

from __future__ import annotations

from uavlinkd.core.drops import Reason

UNVERIFIED = (
    "the peer's frames arrive, its echo replies do not: the direction back is blocked, or an attacker delays frames."
    " Commands, missions, parameters and manual control are held and dropped; reports pass and may be old"
)
"""The meaning of unverified freshness."""


class LinkProblem(Reason):
    """What the daemon counts for a peer although it drops no datagram."""

    ENVELOPES_MISSING = "envelopes_missing", "envelopes did not arrive: the radio is bad, or an attacker drops them"
    ENVELOPES_OUT_OF_ORDER = (
        "envelopes_out_of_order",
        "envelopes arrived after later ones: the network has several paths, or an attacker reorders them",
    )
    PATHS_UNPROVEN = (
        "paths_unproven",
        "the peer's envelopes came from an address that is not the peer's: an attacker forwards them",
    )
    ECHOES_UNANSWERED = (
        "echoes_unanswered",
        "the peer did not answer echo requests: it does not receive them, or an attacker drops the replies",
    )
    HANDSHAKES_UNANSWERED = (
        "handshakes_unanswered",
        "the daemon repeated handshakes while the peer was up: the radio is bad, or an attacker drops them",
    )
    COOKIES_TAKEN = (
        "cookies_taken",
        "the peer asked for proof of this daemon's address: it is under load, or an attacker forges its replies",
    )
