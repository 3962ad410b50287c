"""The protocol of one daemon: every peer, and the dispatch of what arrives at its socket.

Three inputs: a datagram, frames to send, the passing of time. Each call returns what the shell has to do, in
order. ``now`` is monotonic seconds and never goes back. Nothing here raises for anything that a peer or a stranger
sends; any exception is a fault of ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence

from uavlinkd.core import constants as c
from uavlinkd.core import establish, handshake, probing, wire
from uavlinkd.core.admission import Admission, CookieRequired, Message
from uavlinkd.core.cookie import CookieJar, MacKeys, mac1_of
from uavlinkd.core.crypto import Entropy, KeyPair, Secret, equal
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.indices import Indices
from uavlinkd.core.initiator import Pending
from uavlinkd.core.outputs import Deliver, Dropped, Output
from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.peer import Peer
from uavlinkd.core.probing import ask_candidates
from uavlinkd.core.receive import receive_envelope
from uavlinkd.core.refusals import Refused
from uavlinkd.core.relay_records import Record
from uavlinkd.core.send import ask_for_echo, note_repeat, recount, report_refusals, send_frames, send_record
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Class, PeerSettings, Screen, hold_all
from uavlinkd.core.socket_facts import SocketFacts
from uavlinkd.core.timeouts import handle_timeout
from uavlinkd.core.timers import Schedule
from uavlinkd.core.versions import version_of

_MAVLINK_STARTS = frozenset((0xFD, 0xFE))
_NOT_OUR_VERSION = frozenset((DropReason.MALFORMED, DropReason.BAD_MAC1))


class Node:
    """All peers of one identity.

    Args:
        private_key: the static X25519 key of this daemon.
        entropy: returns unpredictable bytes.
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
        self._indices = Indices[tuple[Peer, Session | Pending]](entropy)
        self._by_keys: dict[tuple[bytes, bytes], Peer] = {}  # ours, theirs
        self._by_address: dict[SocketAddress, Peer] = {}
        self._remembered: dict[bytes, Peer] = {}  # by the ephemeral of an authentic initiation: its sender
        self._last_seen: Counter[SocketAddress] = Counter()  # where peers have proved to be, and how many
        self._facts = SocketFacts()
        self._admission = Admission(self._is_known, now)
        self._schedule = Schedule[Peer]()
        self.peers: dict[str, Peer] = {}
        """By name."""
        self.drops: Counter[DropReason] = Counter()
        """Datagrams that name no peer; those that name one are counted there."""

    @property
    def public_key(self) -> bytes:
        """This daemon's identity."""
        return self._identity.public

    # Peers.

    def add_peer(self, settings: PeerSettings, now: float, *, by_previous_key: bool = False) -> Peer:
        """Accept this peer from now on. Without an address it has to initiate.

        ``by_previous_key``: it knows us by our previous key. While keys change, neither end can tell which keys the
        other has, so a peer is added once for each pair of keys that may be valid, by different names.

        Raises:
            ValueError: the name or the pair of keys is there already, the peer's key is one of ours, or
                ``by_previous_key`` without a previous key.
        """
        identity, previous = self._identity, None if self._previous is None else self._previous.identity
        if by_previous_key:
            if previous is None:
                raise ValueError(f"peer {settings.name} cannot know a previous key: this node has only one")
            identity = previous
        keys = identity.public, settings.public_key
        if settings.name in self.peers or keys in self._by_keys:
            raise ValueError(f"peer {settings.name} is there already")
        if settings.public_key in (self.public_key, None if previous is None else previous.public):
            raise ValueError(f"peer {settings.name} has this daemon's own key")
        shared = self._screen, self._last_seen, self._facts
        peer = Peer(settings, identity, self._indices, self._entropy, now, *shared)
        self.peers[settings.name] = self._by_keys[keys] = peer
        self._facts.share_budgets(len(self.peers))
        self._admission.set_peers(len(self.peers))
        return peer

    def forget_previous_key(self) -> None:
        """Accept nothing for our previous key any more. Remove the peers by it first."""
        self._previous = None

    def remove_peer(self, peer: Peer, now: float) -> list[Output]:
        """Cut this peer off at once: its keys are forgotten, and nothing from it is accepted any more."""
        del self.peers[peer.name]
        self._facts.share_budgets(len(self.peers))
        self._admission.set_peers(len(self.peers))
        self._by_keys = {keys: other for keys, other in self._by_keys.items() if other is not peer}
        self._forget_addresses(peer)
        for ephemeral in peer.remembered:
            self._remembered.pop(ephemeral, None)
        out = establish.close(peer, now)
        peer.paths.clear()
        self._schedule.remove(peer)
        return out

    def set_paths(self, peer: Peer, paths: Iterable[Path], now: float) -> None:
        """Where to initiate to this peer, the likeliest first. A path that works stays in use."""
        self._forget_addresses(peer)
        before = peer.paths.configured
        peer.paths.configure(paths, now)
        for path in peer.paths.configured:
            if path.is_relayed and path not in before and not peer.is_up:
                peer.initiator.invite(now)  # its handle shows that the peer asked for this node just now
        for path in peer.paths.configured:
            self._by_address[path.place] = peer
        self._revise_paths(peer, now)

    def set_metered(self, sockets: Iterable[int], now: float) -> None:
        """The sockets whose network is paid by the byte. This hastens no try."""
        self._facts.metered = set(sockets)
        for peer in self.peers.values():
            peer.paths.set_metered()
            self._revise_paths(peer, now)

    def set_budgets(self, budgets: Mapping[int, float]) -> None:
        """The bits a second that the networks of these sockets carry, of all peers together."""
        self._facts.set_budgets(budgets)
        self._facts.share_budgets(len(self.peers))

    def set_rates(self, rates: Mapping[int, float], now: float) -> None:
        """The bits a second that networks with a budget carry at present. Tries and probes follow them."""
        self._facts.set_rates(rates)
        for peer in self.peers.values():
            self._revise_paths(peer, now)

    def set_envelope_limits(self, limits: Mapping[int, int]) -> None:
        """The longest envelopes for the networks of these sockets, in bytes: :func:`.envelope_limit.limit_at`.

        Frames share an envelope up to there; a longer one holds a single frame. The limits of other sockets end.
        """
        self._facts.envelope_limits = dict(limits)

    def set_point_to_point(self, peers: Mapping[int, Iterable[Peer]]) -> None:
        """The peers at the other end of these sockets: one daemon, which may have several pairs of keys.

        Datagrams of other peers that arrive there are dropped, as ``wrong_network``. Other sockets may have any peer.
        """
        self._facts.set_point_to_point(peers)

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> None:
        """The network behind a socket disappeared; or it appeared or changed, and its paths have to prove themselves.

        The events come with the next :meth:`handle_timeout`, which is due at once.
        """
        for peer in self.peers.values():
            if peer.paths.set_socket_state(socket, now, is_up=is_up) and is_up:
                peer.initiator.hurry(socket, now)
            self._revise_paths(peer, now)

    def _revise_paths(self, peer: Peer, now: float) -> None:
        peer.paths.revise(now)
        peer.set_paths_timer()
        peer.set_initiate()
        self._schedule.update(peer)

    # Inputs.

    def send(self, peer: Peer, frames: Sequence[bytes], now: float, cls: Class = Class.STREAM) -> list[Output]:
        """Send frames of one class that are here together to a peer, in as few envelopes as hold them."""
        out = send_frames(peer, frames, now, cls)
        if peer.timers.next_at < peer.timers.scheduled_at:
            self._schedule.update(peer)
        return out

    def recount(self, peer: Peer, path: Path, datagrams: int, size: int) -> None:
        """A copy that :meth:`send` returned waits or is dropped (-1 datagram), or is sent after it waited (1).

        Otherwise the path would seem to lose what was never sent along it. ``size``: in bytes, with the same sign.
        """
        recount(peer, path, datagrams, size)

    def note_repeat(self, peer: Peer, path: Path, number: int, datagram: bytes) -> None:
        """A datagram that :meth:`send` returned is sent along this path again.

        ``number``: which transmission of the envelope it is along this path, 2 to :data:`c.TRANSMISSIONS`.
        """
        note_repeat(peer, path, number, datagram)

    def report_refusals(self, peer: Peer, changed: Iterable[Refused], now: float) -> list[Output]:
        """Report to the peer which of its frames are refused here: totals that changed since the last call."""
        return report_refusals(peer, changed, now)

    def send_record(self, peer: Peer, path: Path, record: Record, now: float) -> list[Output]:
        """Send a record to a relay or to a member, along one path, which works; otherwise nothing is sent."""
        return send_record(peer, path, record, now)

    def set_candidates(self, peer: Peer, paths: Iterable[Path]) -> None:
        """Paths along which the peer may be reached directly. They get no slot before an authentic envelope came."""
        peer.paths.set_candidates(paths)

    def ask_candidates(self, peer: Peer, now: float) -> list[Output]:
        """Send a question to each candidate without a slot; to fewer of them if that was done often."""
        return ask_candidates(peer, now)

    def ask(self, peer: Peer, path: Path, now: float) -> list[Output]:
        """Ask along one path now whether the peer is there. Without an answer in time, the node initiates to it."""
        session, state = peer.sending_session(), peer.paths.find(path)
        if session is None or state is None or state.is_off:
            return []
        out = ask_for_echo(peer, session, now, (state,))
        if peer.paths.has_several:
            out += probing.ask(peer, session, state, now) + probing.update(peer, now)
        self._schedule.update(peer)
        return out

    def receive(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        """What to do about a datagram. Never raises, whatever the bytes."""
        try:
            if datagram[:1] not in wire.ENVELOPE_STARTS:
                return self._receive_handshake(datagram, path, now)
            index, counter, header_bytes = wire.parse_envelope_header(datagram)
            peer, session = self._indices.owners.get(index, (None, None))
            if peer is None or not isinstance(session, Session):
                return self._receive_stray(datagram, index, path, now)
            if self._facts.peers_at:
                self._check_network(peer, path)
            out = receive_envelope(peer, session, datagram, header_bytes, counter, path, now)
            if peer.timers.next_at < peer.timers.scheduled_at:
                self._schedule.update(peer)
            return out
        except Drop as drop:
            return [self._count(datagram, drop, path)]

    def handle_timeout(self, now: float) -> list[Output]:
        """Do what is due. Call it at :meth:`next_deadline`, or at any time."""
        out: list[Output] = []
        for peer in self._schedule.pop(now):
            out += handle_timeout(peer, now)
            self._schedule.update(peer)
        return out

    def next_deadline(self) -> float:
        """When :meth:`handle_timeout` is to be called next; infinity for never."""
        return self._schedule.next_at

    def close(self, now: float) -> list[Output]:
        """Close the sessions with every peer."""
        out: list[Output] = []
        for peer in self.peers.values():
            out += establish.close(peer, now)
            self._schedule.remove(peer)
        return out

    # For a busy shell.

    def pop_held(self) -> list[Output]:
        """Hold no frames any more that wait for a proof of freshness.

        Only for a shell that drops them: this process stood still, and they may be from before that.
        """
        return [
            Deliver(peer, payload)
            for peer in self.peers.values()
            for session in peer.sessions.confirmed
            for payload in session.held.pop_all()
        ]

    def claimed_sender(self, datagram: bytes, path: Path) -> Hashable:
        """The sender that a datagram claims to have. A busy shell lets senders take turns; nothing is authentic yet.

        Of each peer the datagrams from its paths, and those from elsewhere, are two senders: a forger of its
        envelopes has to forge its address too. So is each address where a peer is known to be, for datagrams that
        name no session. All others are one.
        """
        if datagram[:1] in wire.ENVELOPE_STARTS and (peer := self._claimed_peer(datagram)) is not None:
            state = peer.paths.find(path)
            return peer, state is not None and state.is_proven
        return path.sender if self._is_known(path.place) else None

    def refuse(self, datagram: bytes, path: Path) -> Dropped:
        """Count a datagram that a busy shell does not hand over: its sender has more waiting than its share."""
        return self._count(datagram, Drop(DropReason.OVER_SHARE), path)

    # Envelopes without a session.

    def _receive_stray(self, datagram: bytes, index: int, path: Path, now: float) -> list[Output]:
        if self._indices.is_quarantined(index, now):
            raise Drop(DropReason.LATE)
        out: list[Output] = []
        if (peer := self._by_address.get(path.place)) is not None:
            out += establish.receive_hint(peer, now)
            self._schedule.update(peer)
        return [*out, self._count(datagram, Drop(DropReason.UNKNOWN_INDEX), path)]

    # Handshake messages, the cheapest check first.

    def _receive_handshake(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        kind = datagram[0] if datagram else 0
        try:
            if kind == wire.INITIATION:
                try:
                    return self._receive_initiation(datagram, path, now)
                except Drop as drop:
                    self._name_version(drop.reason, datagram, path, now)
                    raise
            if kind == wire.RESPONSE:
                return self._receive_response(datagram, path, now)
        except CookieRequired as drop:
            return [drop.reply, self._count(datagram, drop, path)]
        if kind == wire.COOKIE:
            return self._receive_cookie(datagram, path, now)
        raise Drop(DropReason.RAW_MAVLINK if kind in _MAVLINK_STARTS else DropReason.MALFORMED)

    def _receive_initiation(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        initiation = wire.parse_initiation(datagram)
        self._admission.read(path, now)
        identity, cookies = self._addressed(datagram)
        sender = self._remembered.get(initiation.ephemeral)
        if sender is not None:  # before the budget: one recording must not use it up
            self._check_network(sender, path)
            return self._answer_copy(sender, datagram, path, now)
        message = Message(datagram, initiation.sender_index, path, cookies)
        self._admission.admit_initiation(message, now)
        received = handshake.receive_initiation(identity, initiation)
        peer = self._by_keys.get((identity.public, received.public_key))
        if peer is None:
            raise Drop(DropReason.UNKNOWN_PEER, received.public_key)
        # Before it is remembered: otherwise a line could use up what this peer sends along its own network.
        self._check_network(peer, path)
        self._remember(peer, initiation.ephemeral)
        try:
            out = self._answer(peer, received, message, now)
        except CookieRequired as drop:
            return [drop.reply, peer.drop_datagram(drop.reason, path)]
        except Drop as drop:
            return [peer.drop_datagram(drop.reason, path, drop.detail)]
        self._schedule.update(peer)
        return out

    def _answer_copy(self, peer: Peer, datagram: bytes, path: Path, now: float) -> list[Output]:
        """An initiation of this peer that was read before: it sends one along several paths.

        Raises:
            Drop: ``REPLAYED_INITIATION``, or ``DUPLICATE`` if the response went along this path already.
        """
        mac1 = mac1_of(datagram)
        for waiting in peer.sessions.unconfirmed.values():
            if equal(waiting.initiation_mac1, mac1):
                out = establish.answer_copy(peer, waiting, path, now)
                return [*out, peer.drop_datagram(DropReason.DUPLICATE, path)]
        raise Drop(DropReason.REPLAYED_INITIATION)

    def _answer(self, peer: Peer, received: handshake.Received, message: Message, now: float) -> list[Output]:
        suite = received.initiation.suite
        self._admission.admit_answer(peer, message, now)
        if suite not in peer.settings.link.suites:
            raise Drop(DropReason.SUITE_NOT_ACCEPTED, suite.name)
        if suite.has_group:
            self._admission.admit_group(peer, suite, message, now)
        return establish.answer(peer, received, message.datagram, message.path, now)

    def _receive_response(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        response = wire.parse_response(datagram)
        peer, pending = self._indices.owners.get(response.receiver_index, (None, None))
        if peer is None or not isinstance(pending, Pending):
            # The peer sends its response along several paths; the first one made the session.
            is_copy = isinstance(pending, Session) and pending.remote_index == response.sender_index
            raise Drop(DropReason.DUPLICATE if is_copy else DropReason.UNEXPECTED_RESPONSE)
        self._check_network(peer, path)
        _, cookies = self._addressed(datagram)
        self._admission.admit_response(Message(datagram, response.sender_index, path, cookies), now)
        out = establish.receive_response(peer, pending, response, path, now)
        self._schedule.update(peer)
        return out

    def _receive_cookie(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        reply = wire.parse_cookie_reply(datagram)
        peer, owner = self._indices.owners.get(reply.receiver_index, (None, None))
        if peer is None:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        asked = owner if isinstance(owner, Pending) else peer.sessions.unconfirmed.get(reply.receiver_index)
        # One for each message and path: an observer can make more, but has to be faster than the peer each time.
        if asked is None or path not in asked.paths or path in asked.cookied:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        establish.receive_cookie(peer, asked.mac1, path, reply, now)
        asked.cookied.add(path)
        self._schedule.update(peer)
        return []

    def _addressed(self, datagram: bytes) -> tuple[KeyPair, CookieJar]:
        """Which of our keys a handshake message is for.

        Raises:
            Drop: ``BAD_MAC1`` if it is for none of them.
        """
        try:
            self._mac_keys.check_mac1(datagram)
        except Drop:
            if self._previous is None:
                raise
            self._previous.mac_keys.check_mac1(datagram)
            return self._previous.identity, self._previous.cookies
        return self._identity, self._cookies

    def _name_version(self, reason: DropReason, datagram: bytes, path: Path, now: float) -> None:
        """Another version may have other lengths (malformed), and has another label of mac1.

        Raises:
            Drop: ``OTHER_VERSION``.
        """
        if reason not in _NOT_OUR_VERSION or not self._admission.may_compare_versions(path, now):
            return
        identities = [self._identity] + ([] if self._previous is None else [self._previous.identity])
        if (version := version_of(datagram, (identity.public for identity in identities))) is not None:
            raise Drop(DropReason.OTHER_VERSION, version)

    def _remember(self, peer: Peer, ephemeral: bytes) -> None:
        # A memory for each peer: no peer can make us forget what another sent.
        self._remembered[ephemeral] = peer
        peer.remembered.append(ephemeral)
        if len(peer.remembered) > c.REMEMBERED_INITIATIONS:
            self._remembered.pop(peer.remembered.popleft(), None)

    # Where peers are.

    def _check_network(self, peer: Peer, path: Path) -> None:
        """A datagram names this peer, or is of it.

        Raises:
            Drop: ``WRONG_NETWORK`` if it came along a network with another peer at its other end.
        """
        if not self._facts.leads_to(path.socket, peer):
            raise Drop(DropReason.WRONG_NETWORK)

    def _is_known(self, address: SocketAddress) -> bool:
        """Whether a peer is configured at an address, or was last seen there."""
        return address in self._by_address or address in self._last_seen

    def _forget_addresses(self, peer: Peer) -> None:
        for path in peer.paths.configured:
            if self._by_address.get(path.place) is peer:
                del self._by_address[path.place]

    # Drops.

    def _count(self, datagram: bytes, drop: Drop, path: Path) -> Dropped:
        if (peer := self._claimed_peer(datagram)) is not None:
            return peer.drop_datagram(drop.reason, path, drop.detail)
        self.drops[drop.reason] += 1
        return Dropped(drop.reason, None, path, 1, drop.detail)

    def _claimed_peer(self, datagram: bytes) -> Peer | None:
        """The peer whose session or handshake the header names: a claim, good for a counter and no more."""
        index = wire.claimed_receiver_index(datagram)
        owner = self._indices.owners.get(index) if index else None
        return None if owner is None else owner[0]


class _Previous:
    """The previous identity, and what goes with it."""

    __slots__ = ("cookies", "identity", "mac_keys")

    def __init__(self, private_key: Secret, entropy: Entropy, now: float) -> None:
        self.identity = KeyPair(private_key.reveal())
        self.mac_keys = MacKeys(self.identity.public)
        self.cookies = CookieJar(self.mac_keys, entropy, now)
