"""Problems of a link that no single datagram causes: their names in status, metrics and log, and their meanings."""

from __future__ import annotations

from uavlinkd.core.drops import Reason


class LinkProblem(Reason):
    """What the daemon counts for a peer although it drops no datagram."""

    ENVELOPES_MISSING = "envelopes_missing", "envelopes did not arrive: the radio is bad, or an attacker drops them"
    ENVELOPES_OUT_OF_ORDER = (
        "envelopes_out_of_order",
        "envelopes arrived after later ones: the network has several paths, or an attacker reorders them",
        "out of order",
    )
    PATHS_UNPROVEN = (
        "paths_unproven",
        "the peer's envelopes came from an address that is not the peer's: an attacker forwards them",
        "addresses without an answer",
    )
    ECHOES_UNANSWERED = (
        "echoes_unanswered",
        "the peer did not answer echo requests: it does not receive them, or an attacker drops the replies",
        "unanswered echo requests",
    )
    HANDSHAKES_UNANSWERED = (
        "handshakes_unanswered",
        "the daemon repeated handshakes while the peer was up: the radio is bad, or an attacker drops them",
        "unanswered handshakes",
    )
    COOKIES_TAKEN = (
        "cookies_taken",
        "the peer asked for proof of this daemon's address: it is under load, or an attacker forges its replies",
        "cookies requested by the peer",
    )
