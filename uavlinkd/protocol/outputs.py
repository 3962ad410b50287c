"""What the core asks of the shell: returned by the call that caused it, in the order to be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from uavlinkd.protocol.drops import Detail, DropReason
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import Record


class LinkedPeer(Protocol):
    """The peer that an output is about: the object that :meth:`uavlinkd.protocol.node.Node.add_peer` returned."""

    @property
    def name(self) -> str:
        """Its name in the configuration of this node."""


new_tuple: Callable[..., Any] = tuple.__new__
"""Makes an output from its class and all its fields, without the Python function that a named tuple has for it."""


class Transmit(NamedTuple):
    """Send this datagram along this path."""

    datagram: bytes
    path: Path


class Deliver(NamedTuple):
    """Whole MAVLink frames, back to back, from this peer: authentic, unaltered, new."""

    peer: LinkedPeer
    payload: bytes
    order: int = 0
    """Grows in the order in which the peer sealed its envelopes, also from one session to the next."""


class RecordReceived(NamedTuple):
    """A record of a member or a relay came along this path. ``order`` grows as the peer seals records.

    It may be old: a later one along the same path counts.
    """

    peer: LinkedPeer
    path: Path
    record: Record
    order: int


class Dropped(NamedTuple):
    """``number`` datagrams or frames were dropped. ``peer`` is the peer whose session the header names, or None.

    ``detail`` is a fact about the datagram, as in :class:`~uavlinkd.protocol.drops.Drop`.
    """

    reason: DropReason
    peer: LinkedPeer | None = None
    path: Path | None = None
    number: int = 1
    detail: Detail = ""


class CertificateShown(NamedTuple):
    """An initiation with this authentic static key shows a certificate: the shell decides. Nothing has changed yet.

    It is answered by :meth:`uavlinkd.protocol.node.Node.admit` or
    :meth:`~uavlinkd.protocol.node.Node.refuse_certificate`. It may be a replay: other peers are concerned only when
    :class:`PeerAdmitted` follows.
    """

    key: bytes
    certificate: bytes
    path: Path
    initiation: object
    """What the node needs to answer it."""


class PeerAdmitted(NamedTuple):
    """The first envelope of a session came whose initiation showed this certificate: the peer is there with it.

    A new peer is provisional until :meth:`uavlinkd.protocol.node.Node.accept`.
    """

    peer: LinkedPeer
    certificate: bytes


class PeerExpired(NamedTuple):
    """A peer that showed a certificate did not prove that it is there, and was removed."""

    peer: LinkedPeer


class PeerUp(NamedTuple):
    """A valid envelope or response came from a peer that was not up."""

    peer: LinkedPeer


class PeerLost(NamedTuple):
    """Nothing valid came from the peer for ``silent_s`` seconds, or its last session ended."""

    peer: LinkedPeer
    silent_s: float


class PeerClosed(NamedTuple):
    """The peer closed its sessions."""

    peer: LinkedPeer


class SessionEstablished(NamedTuple):
    """New keys carry the traffic from now on. ``rekey``: they replace others.

    ``path``: along which the peer proved that it has them. It need not be the best one.
    """

    peer: LinkedPeer
    path: Path
    generation: int
    suite: str
    confidential: bool
    tag_bytes: int
    initiator: bool
    rekey: bool


class PathChanged(NamedTuple):
    """Traffic goes along ``path`` now, and went along ``before``.

    ``reason``: ``faster``, ``direct`` (and before it was relayed), ``loss``, ``metered``, ``session`` (it was made
    there), or why the path before failed: ``unanswered``, ``network``.
    """

    peer: LinkedPeer
    path: Path
    before: Path
    reason: str


class PathStateChanged(NamedTuple):
    """A path became usable, or went down. ``reason``: that of its state."""

    peer: LinkedPeer
    path: Path
    is_usable: bool
    reason: str


class PathSuspected(NamedTuple):
    """A relayed path failed a moment ago. The relay may be the reason: ask it."""

    peer: LinkedPeer
    path: Path


PathEvent = PathChanged | PathStateChanged | PathSuspected
Event = PeerAdmitted | PeerExpired | PeerUp | PeerLost | PeerClosed | SessionEstablished | PathEvent
Output = Transmit | Deliver | RecordReceived | Dropped | CertificateShown | Event
