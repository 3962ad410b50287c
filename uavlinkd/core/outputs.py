"""What the core asks of the shell: returned by the call that caused it, in the order to be done."""

from __future__ import annotations

from typing import NamedTuple

from uavlinkd.core.drops import DropReason

Path = tuple[int, str, int]
"""One way to a peer: (number of the local socket, the peer's numeric host, its port)."""


class Transmit(NamedTuple):
    """Send this datagram along this path."""

    datagram: bytes
    path: Path


class Deliver(NamedTuple):
    """Whole MAVLink frames, back to back, from this peer: authentic, unaltered, new."""

    peer: str
    payload: bytes


class Dropped(NamedTuple):
    """``amount`` datagrams or frames were discarded. ``peer`` is whose session the header claims, None without."""

    reason: DropReason
    peer: str | None = None
    path: Path | None = None
    amount: int = 1
    detail: str = ""


class PeerUp(NamedTuple):
    """A valid envelope or response came from a peer that was not up."""

    peer: str


class PeerLost(NamedTuple):
    """Nothing valid came from the peer for ``silent_s`` seconds, or its last session ended."""

    peer: str
    silent_s: float


class PeerClosed(NamedTuple):
    """The peer said goodbye."""

    peer: str


class SessionEstablished(NamedTuple):
    """New keys carry the traffic from now on. ``rekey`` where they replace others."""

    peer: str
    generation: int
    suite: str
    confidential: bool
    tag_bytes: int
    initiator: bool
    rekey: bool


class PathChanged(NamedTuple):
    """The peer proved that it hears us at ``path``; traffic goes there now."""

    peer: str
    path: Path


class FreshnessUnverified(NamedTuple):
    """Frames of the peer arrive, and it does not answer: those that must be new are held back, the others pass."""

    peer: str


class FreshnessVerified(NamedTuple):
    """The peer answers again, ``unverified_s`` after it stopped."""

    peer: str
    unverified_s: float


Event = PeerUp | PeerLost | PeerClosed | SessionEstablished | PathChanged | FreshnessUnverified | FreshnessVerified
Output = Transmit | Deliver | Dropped | Event
