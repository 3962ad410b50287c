"""Findings: each names one cause that stops frames or threatens a link, and its remedy. Problems that are counted."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

from uavlinkd.core.drops import Reason

IS_REACHABLE: Final = "`nc -zvw3 {} 22` shows whether the host is reachable by TCP: connected and refused mean yes"
"""A remedy beside a silent relay."""


def titled(kind: str, name: str) -> str:
    """A name behind its kind, unless it says that already: ``relay vps``, ``relay1``."""
    return name if name.startswith(kind) else f"{kind} {name}"


class Severity(IntEnum):
    """How much a finding matters. The smallest is shown first."""

    SECURITY = 0  # an attack, or a key in two places
    FAULT = 1  # frames do not pass
    WARNING = 2  # frames pass, or none is there to pass


class Subject(IntEnum):
    DAEMON = 0
    PEER = 1
    ENDPOINT = 2


class Finding(NamedTuple):
    """One cause with its remedy, as ``status`` shows it in one line."""

    cause: str  # its code, such as `wrong_psk`: a word of a closed list, for scripts
    severity: Severity
    subject: Subject
    name: str  # the peer's or endpoint's name; empty for the daemon
    text: str  # what is wrong, with the facts: one sentence without a full stop
    remedy: str  # what the operator does: one sentence without a full stop

    def as_json(self) -> dict[str, str]:
        """Plain values for ``status --json``."""
        return {
            field: value.name.lower() if isinstance(value, IntEnum) else value
            for field, value in self._asdict().items()
        }


class LinkProblem(Reason):
    """What the daemon counts for a peer although it drops no datagram."""

    ENVELOPES_MISSING = "envelopes_missing", "envelopes did not arrive: the radio is bad, or an attacker drops them"
    ENVELOPES_OUT_OF_ORDER = (
        "envelopes_out_of_order",
        "envelopes with frames arrived after later ones: the network has several paths, or an attacker reorders them",
    )
    PATHS_UNPROVEN = (
        "paths_unproven",
        "envelopes of the peer came from an address that did not answer: its network changes, an attacker forwards"
        " them, or a second machine has its key",
        "addresses without an answer",
    )
    ECHOES_UNANSWERED = (
        "echoes_unanswered",
        "the peer did not answer echo requests: it restarts, does not receive them, or an attacker drops replies",
        "unanswered echo requests",
    )
    HANDSHAKES_UNANSWERED = (
        "handshakes_unanswered",
        "the daemon repeated handshakes while the peer was up: it restarts, the radio is bad, or an attacker drops"
        " them",
        "unanswered handshakes",
    )
    COOKIES_TAKEN = (
        "cookies_taken",
        "the peer asked for proof of this daemon's address: it is under load, or an attacker forges its replies",
        "cookies requested by the peer",
    )
