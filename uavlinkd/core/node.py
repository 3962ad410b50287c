"""The protocol of one daemon: every peer, and the dispatch of what arrives at its socket.

Three inputs: a datagram, frames to send, the passing of time. Each call returns what the shell has to do, in
order. ``now`` is monotonic seconds and never goes back. Nothing here raises for anything that a peer or a stranger
sends; any exception is a fault of ours.
"""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence

from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.admission import Admission, Message
from uavlinkd.core.initiator import Pending
from uavlinkd.core.constants import NEVER
from uavlinkd.core.cookie import CookieJar, MacKeys
from uavlinkd.core.crypto import Entropy, KeyPair, Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.indices import Indices
from uavlinkd.core.outputs import Dropped, Output, Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.session import Session
from uavlinkd.core.settings import PeerSettings, Screen, hold_all

_MAVLINK_STARTS = frozenset((0xFD, 0xFE))


class Node:
    """All peers of one identity.

    Args:
        private_key: the static X25519 key of this daemon.
        entropy: gives unpredictable bytes.
        now: monotonic seconds.
        previous_private_key: the one before, while it is being changed: peers can be added that know us by it.
        screen: splits a payload into frames that may be old and frames that must be new. By default all must be new.
    """

    def __init__(
        self,
        private_key: Secret,
        entropy: Entropy,
        now: float,
        previous_private_key: Secret | None = None,
        *,
        screen: Screen = hold_all,
    ) -> None:
        self._screen = screen
        self._identity = KeyPair(private_key.reveal())
        self._entropy = entropy
        self._mac_keys = MacKeys(self._identity.public)
        self._cookies = CookieJar(self._mac_keys, entropy, now)
        self._previous = None if previous_private_key is None else _Previous(previous_private_key, entropy, now)
        self._indices = Indices(entropy)
        self._by_keys: dict[tuple[bytes, bytes], Peer] = {}  # ours, theirs
        self._by_address: dict[tuple[str, int], Peer] = {}
        self._remembered: set[bytes] = set()  # ephemerals of authentic initiations, of every peer
        self._last_seen: set[tuple[str, int]] = set()  # where peers are, as far as they proved
        self._admission = Admission(self._is_known, now)
        self._deadline = NEVER
        self.peers: dict[str, Peer] = {}
        """By name."""
        self.drops: Counter[DropReason] = Counter()
        """Datagrams that no peer can be held to; what names a peer is counted there."""

    @property
    def public_key(self) -> bytes:
        """This daemon's identity."""
        return self._identity.public

    # Peers.

    def add_peer(self, settings: PeerSettings, now: float, *, by_previous_key: bool = False) -> None:
        """Accept this peer from now on. Without an address it has to call.

        ``by_previous_key``: as one that knows us by our previous key. While keys change nobody can tell who has
        which, so a peer is added once for each pair of keys that may be right, by different names.

        Raises:
            ValueError: the name or the pair of keys is there already, the peer's key is one of ours, or
                ``by_previous_key`` without a previous key.
        """
        identity, previous = self._identity, None if self._previous is None else self._previous.identity
        if by_previous_key:
            if previous is None:
                raise ValueError(f"peer {settings.name} cannot know a previous key: there is none")
            identity = previous
        keys = identity.public, settings.public_key
        if settings.name in self.peers or keys in self._by_keys:
            raise ValueError(f"peer {settings.name} is there already")
        if settings.public_key in (self.public_key, None if previous is None else previous.public):
            raise ValueError(f"peer {settings.name} has this daemon's own key")
        peer = Peer(settings, identity, self._indices, self._entropy, now, self._screen)
        self.peers[settings.name] = self._by_keys[keys] = peer
        self._deadline = min(self._deadline, now)

    def forget_previous_key(self) -> None:
        """Nothing is for our previous key any more. Remove the peers by it first."""
        self._previous = None

    def remove_peer(self, name: str, now: float) -> list[Output]:
        """Cut this peer off at once: its keys are forgotten, nothing of it is accepted any more."""
        out: list[Output] = []
        peer = self.peers.pop(name)
        self._by_keys = {keys: each for keys, each in self._by_keys.items() if each is not peer}
        self._by_address = {at: each for at, each in self._by_address.items() if each is not peer}
        self._remembered.difference_update(peer.remembered)
        self._note_places()
        peer.close(now, out)
        return out

    def set_addresses(self, name: str, addresses: Iterable[Path], now: float) -> None:
        """Where to call this peer, the likeliest first. An authenticated path goes on being used."""
        peer = self.peers[name]
        peer.caller.addresses = tuple(addresses)
        peer.deadline = min(peer.deadline, now)
        self._deadline = min(self._deadline, now)
        self._by_address = {at: each for at, each in self._by_address.items() if each is not peer}
        for _, host, port in peer.caller.addresses:
            self._by_address[host, port] = peer

    # Inputs.

    def send(self, peer_name: str, frames: Sequence[bytes], now: float) -> list[Output]:
        """Send frames that are here together to a peer, in as few envelopes as hold them."""
        peer = self.peers[peer_name]
        out: list[Output] = []
        peer.send(frames, now, out)
        self._deadline = min(self._deadline, peer.deadline)
        return out

    def receive(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        """What to do about a datagram. Never raises, whatever the bytes."""
        out: list[Output] = []
        try:
            self._receive(datagram, path, now, out)
        except Drop as drop:  # the one place where a datagram is dropped
            out.append(self._count(datagram, drop, path))
        return out

    def take_held(self) -> list[Output]:
        """Hold the frames no more that wait for a peer's word.

        Only for a shell that drops them: this process stood still, and they may be from before that.
        """
        out: list[Output] = []
        for peer in self.peers.values():
            peer.take_held(out)
        return out

    def _count(self, datagram: bytes, drop: Drop, path: Path) -> Dropped:
        peer = self.peers.get(drop.peer) or self._claimed_peer(datagram)
        (peer.traffic.drops if peer else self.drops)[drop.reason] += 1
        return Dropped(drop.reason, peer.name if peer else None, path, 1, drop.detail)

    def sender_of(self, datagram: bytes, path: Path) -> Hashable:
        """Whose datagram it claims to be. A busy shell lets senders take turns; nothing is authenticated yet.

        Of each peer the datagrams from where it is, and those from elsewhere, are two senders: a forger of its
        envelopes has to forge its address too. So is each address where a peer is known to be, for datagrams that
        name no session. All others are one.
        """
        if datagram[:1] in wire.ENVELOPE_STARTS and (peer := self._claimed_peer(datagram)) is not None:
            return peer.name, path == peer.path
        address = path[1:]
        return address if self._is_known(address) else None

    def refuse(self, datagram: bytes, path: Path) -> Dropped:
        """Count a datagram that a busy shell does not hand over: its sender has more waiting than its share."""
        return self._count(datagram, Drop(DropReason.OVER_SHARE), path)

    def handle_timeout(self, now: float) -> list[Output]:
        """Do what is due. Call it at :meth:`next_deadline`, or at any time."""
        out: list[Output] = []
        for peer in self.peers.values():
            if peer.deadline <= now:
                peer.handle_timeout(now, out)
        self._deadline = min((peer.deadline for peer in self.peers.values()), default=NEVER)
        return out

    def next_deadline(self) -> float:
        """When :meth:`handle_timeout` is to be called next; infinity for never."""
        return self._deadline

    def close(self, now: float) -> list[Output]:
        """Say goodbye to every peer."""
        out: list[Output] = []
        for peer in self.peers.values():
            peer.close(now, out)
        self._deadline = NEVER
        return out

    # Dispatch, the cheapest check first.

    def _receive(self, datagram: bytes, path: Path, now: float, out: list[Output]) -> None:
        kind = datagram[0] if datagram else 0
        if kind in (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE):
            self._receive_envelope(datagram, path, now, out)
        elif kind == wire.INITIATION:
            self._receive_initiation(datagram, path, now, out)
        elif kind == wire.RESPONSE:
            self._receive_response(datagram, path, now, out)
        elif kind == wire.COOKIE:
            self._receive_cookie(datagram, now)
        elif kind in _MAVLINK_STARTS:
            raise Drop(DropReason.RAW_MAVLINK)
        else:
            raise Drop(DropReason.MALFORMED)

    def _receive_envelope(self, datagram: bytes, path: Path, now: float, out: list[Output]) -> None:
        index, counter, header_bytes = wire.parse_envelope_header(datagram)
        session = self._indices.owners.get(index)
        if not isinstance(session, Session):
            if self._indices.is_quarantined(index, now):
                raise Drop(DropReason.LATE)
            self._hint(path, now, out)
            raise Drop(DropReason.UNKNOWN_INDEX)
        peer = session.peer
        before = peer.path
        try:
            peer.receive_envelope(session, datagram, header_bytes, counter, path, now, out)
        finally:
            self._deadline = min(self._deadline, peer.deadline)
            if peer.path is not before:
                self._note_places()

    def _hint(self, path: Path, now: float, out: list[Output]) -> None:
        _, host, port = path
        peer = self._by_address.get((host, port))
        if peer is not None:
            peer.hint(now, out)
            self._deadline = min(self._deadline, peer.deadline)

    def _receive_initiation(self, datagram: bytes, path: Path, now: float, out: list[Output]) -> None:
        initiation = wire.parse_initiation(datagram)
        self._admission.read(path, now)
        identity, cookies = self._addressed(datagram)
        if initiation.ephemeral in self._remembered:  # before the budget: one recording must not use it up
            raise Drop(DropReason.REPLAYED_INITIATION)
        message = Message(datagram, initiation.sender_index, path, cookies)
        self._admission.admit_initiation(message, now, out)
        received = handshake.receive_initiation(identity, initiation)
        peer = self._by_keys.get((identity.public, received.public_key))
        if peer is None:
            raise Drop(DropReason.UNKNOWN_PEER, f"key {b64encode(received.public_key).decode()}")
        self._remember(peer, initiation.ephemeral)
        try:
            self._answer(peer, received, message, now, out)
        except Drop as drop:
            drop.peer = peer.name
            raise

    def _answer(
        self, peer: Peer, received: handshake.Received, message: Message, now: float, out: list[Output]
    ) -> None:
        suite = received.initiation.suite
        self._admission.admit_answer(peer, message, now, out)
        if suite not in peer.settings.link.suites:
            raise Drop(DropReason.SUITE_NOT_ACCEPTED, f"suite {suite.name}")
        if suite.has_group:
            self._admission.admit_group(peer, suite, message, now, out)
        peer.answer(received, message.path, now, out)
        self._deadline = min(self._deadline, peer.deadline)

    def _receive_response(self, datagram: bytes, path: Path, now: float, out: list[Output]) -> None:
        response = wire.parse_response(datagram)
        pending = self._indices.owners.get(response.receiver_index)
        if not isinstance(pending, Pending):
            raise Drop(DropReason.UNEXPECTED_RESPONSE)
        _, cookies = self._addressed(datagram)
        self._admission.admit_response(Message(datagram, response.sender_index, path, cookies), now, out)
        pending.peer.receive_response(pending, response, now, out)
        self._note_places()
        self._deadline = min(self._deadline, pending.peer.deadline)

    def _receive_cookie(self, datagram: bytes, now: float) -> None:
        reply = wire.parse_cookie_reply(datagram)
        owner = self._indices.owners.get(reply.receiver_index)
        if owner is None:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        peer = owner.peer
        asked = owner if isinstance(owner, Pending) else peer.sessions.unconfirmed.get(reply.receiver_index)
        # One for each message, as whoever saw it can make more: he has to be there before the peer, each time.
        if asked is None or asked.has_cookie:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        peer.receive_cookie(asked.mac1, asked.path, reply, now)
        asked.has_cookie = True
        self._deadline = min(self._deadline, peer.deadline)

    def _addressed(self, datagram: bytes) -> tuple[KeyPair, CookieJar]:
        """Which of our keys a handshake message is for.

        Raises:
            Drop: ``BAD_MAC1``: none.
        """
        try:
            self._mac_keys.check_mac1(datagram)
        except Drop:
            if self._previous is None:
                raise
            self._previous.mac_keys.check_mac1(datagram)
            return self._previous.identity, self._previous.cookies
        return self._identity, self._cookies

    def _is_known(self, address: tuple[str, int]) -> bool:
        """Whether a peer is said to be there, or was heard there last."""
        return address in self._by_address or address in self._last_seen

    def _note_places(self) -> None:
        """A peer may be elsewhere than before."""
        self._last_seen = {peer.path[1:] for peer in self.peers.values() if peer.path is not None}

    def _remember(self, peer: Peer, ephemeral: bytes) -> None:
        # A memory for each peer: none can make us forget what another sent.
        self._remembered.add(ephemeral)
        peer.remembered.append(ephemeral)
        if len(peer.remembered) > c.REMEMBERED_INITIATIONS:
            self._remembered.discard(peer.remembered.popleft())

    def _claimed_peer(self, datagram: bytes) -> Peer | None:
        """The peer whose session or handshake the header names: a claim, good for a counter and no more."""
        index = wire.claimed_receiver_index(datagram)
        owner = self._indices.owners.get(index) if index else None
        return owner.peer if owner is not None else None


class _Previous:
    """The identity that we had, and what goes with it."""

    __slots__ = ("cookies", "identity", "mac_keys")

    def __init__(self, private_key: Secret, entropy: Entropy, now: float) -> None:
        self.identity = KeyPair(private_key.reveal())
        self.mac_keys = MacKeys(self.identity.public)
        self.cookies = CookieJar(self.mac_keys, entropy, now)
