"""The protocol of one daemon: every peer, and the dispatch of what arrives at its socket.

Three inputs: a datagram, frames to send, the passing of time. Each call returns what the shell has to do, in
order. ``now`` is monotonic seconds and never goes back. Nothing here raises for anything that a peer or a stranger
sends; any exception is a fault of ours. README.md, section 14.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, probing, wire
from uavlinkd.protocol.admission import Admission
from uavlinkd.protocol.cookie import CookieJar, MacKeys
from uavlinkd.protocol.crypto import Entropy, KeyPair, Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.initiator import Pending
from uavlinkd.protocol.outputs import CertificateShown, Deliver, Dropped, Output, PeerExpired
from uavlinkd.protocol.path import Path, SocketAddress, SocketFacts
from uavlinkd.protocol.path_slots import Route
from uavlinkd.protocol.peer import Peer, Shared
from uavlinkd.protocol.probing import ask_candidates
from uavlinkd.protocol.receive import DatagramReceiver
from uavlinkd.protocol.receive_handshake import HandshakeReceiver, ShownInitiation
from uavlinkd.protocol.relay_records import FleetRecord, Record
from uavlinkd.protocol.send import ask_for_echo, send_frames, send_payloads
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Indices
from uavlinkd.protocol.settings import Class, PeerSettings, Screen, hold_all
from uavlinkd.protocol.timeouts import handle_timeout
from uavlinkd.protocol.timers import Schedule, Timer
from uavlinkd.protocol.wire import Refused

PEERS_AT_ONCE = 8
"""Peers that one call of :meth:`Node.handle_timeout` handles: datagrams wait meanwhile."""


class Node(DatagramReceiver):
    """All peers of one identity.

    Without ``screen`` all frames must be new. ``takes_certificates``: the shell decides on :class:`CertificateShown`.
    ``most_admitted``: peers by certificate.
    """

    def __init__(
        self,
        private_key: Secret,
        entropy: Entropy,
        now: float,
        *,
        screen: Screen = hold_all,
        takes_certificates: bool = False,
        most_admitted: int = 0,
    ) -> None:
        self._screen = screen
        self._entropy = entropy
        self._indices = Indices[tuple[Peer, Session | Pending]](entropy)
        self._by_address: dict[SocketAddress, Peer] = {}
        self._last_seen: Counter[SocketAddress] = Counter()  # where peers have proved to be, and how many
        self.facts = SocketFacts()
        """About the networks behind the sockets."""
        self.schedule = Schedule[Peer]()
        identity, admission = KeyPair(private_key.reveal()), Admission(self._is_known, now, most_admitted)
        cookies = CookieJar(MacKeys(identity.public), entropy, now)
        self._handshakes = HandshakeReceiver(identity, cookies, self._indices, admission, self.facts, self.schedule)
        self._certificate = b""
        self._provisional: set[Peer] = set()
        self._handshakes.takes_certificates = takes_certificates
        self.peers: dict[str, Peer] = {}
        """By name, without provisional ones: another peer may have the name until they prove themselves."""
        self.drops: Counter[DropReason] = Counter()
        """Datagrams that name no peer; those that name one are counted there."""

    @property
    def public_key(self) -> bytes:
        """This daemon's identity."""
        return self._handshakes.identity.public

    # Peers.

    def add_peer(self, settings: PeerSettings, now: float) -> Peer:
        """Accept this peer from now on. Without an address it has to initiate.

        Raises ValueError: the name or the key is there already, or the key is ours.
        """
        if settings.name in self.peers or settings.public_key in self._handshakes.peers:
            raise ValueError(f"peer {settings.name} is there already")
        if settings.public_key == self.public_key:
            raise ValueError(f"peer {settings.name} has this daemon's own key")
        peer = self.peers[settings.name] = self._made(settings, now)
        self._count_peers()
        return peer

    def _made(self, settings: PeerSettings, now: float) -> Peer:
        shared = Shared(self._indices, self._entropy, self._screen, self._last_seen, self.facts)
        peer = self._handshakes.peers[settings.public_key] = Peer(settings, self._handshakes.identity, shared, now)
        if settings.is_certified:
            peer.initiator.certificate = self._certificate
        return peer

    def admit(self, shown: CertificateShown, settings: PeerSettings, now: float) -> list[Output]:
        """The certificate is valid: answer the initiation. A new peer is provisional: it ends without an envelope."""
        assert isinstance(shown.initiation, ShownInitiation)
        peer = self._handshakes.peers.get(shown.key)
        if peer is None:
            peer = self._made(settings, now)
            self._provisional.add(peer)
            peer.provisional_until = now + c.UNCONFIRMED_LIFETIME_S
            peer.set_expiry()
            self.schedule.update(peer)
        try:
            return self._handshakes.answer(peer, shown.initiation, now)
        except Drop as drop:
            return [self.refuse_certificate(shown, drop)]

    def refuse_certificate(self, shown: CertificateShown, drop: Drop) -> Dropped:
        """The certificate is refused for this reason: count the initiation."""
        assert isinstance(shown.initiation, ShownInitiation)
        return self._count(shown.initiation.message.datagram, drop, shown.path)

    def is_provisional(self, peer: Peer) -> bool:
        """Whether a peer has not been accepted yet."""
        return peer in self._provisional

    def accept(self, peer: Peer) -> None:
        """A provisional peer proved itself, or the shell knows it from elsewhere: it stays.

        Raises ValueError if another peer has its name: remove that one first.
        """
        if self.peers.setdefault(peer.name, peer) is not peer:
            raise ValueError(f"peer {peer.name} is there already")
        peer.provisional_until = c.NEVER
        peer.set_expiry()
        self._provisional.discard(peer)
        self._count_peers()

    def _count_peers(self) -> None:
        # Without those that a replayed initiation can make: they must not slow down others.
        self.facts.peers = len(self.peers)
        self._handshakes.admission.set_peers(self.facts.peers)

    def set_certificate(self, certificate: bytes) -> None:
        """Show this certificate to peers by certificate from the next initiation on."""
        self._certificate = certificate
        for peer in self.peers.values():
            if peer.settings.is_certified:
                peer.initiator.certificate = certificate

    def remove_peer(self, peer: Peer, now: float, *, closes: bool = True) -> list[Output]:
        """Cut this peer off at once: its keys are forgotten, and nothing from it is accepted any more.

        ``closes``: it gets a close.
        """
        if self.peers.get(peer.name) is peer:
            del self.peers[peer.name]
        self._provisional.discard(peer)
        self._count_peers()
        self._handshakes.forget(peer)
        self._forget_addresses(peer)
        out = establish.close(peer, now, sends=closes)
        peer.paths.clear()
        self.schedule.remove(peer)
        return out

    def find(self, public_key: bytes) -> Peer | None:
        """The peer with this static key."""
        return self._handshakes.peers.get(public_key)

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

    def offer(self, peer: Peer, features: int, now: float) -> None:
        """Offer other features to a peer from now on. Its session stays until there are new keys.

        A response to an earlier initiation would make a session with the features before.
        """
        if features != peer.settings.link.features:
            peer.settings = replace(peer.settings, link=replace(peer.settings.link, features=features))
            peer.initiator.settings = peer.settings
            peer.initiator.cancel()
            peer.paths.reports_single = bool(features & c.FEATURE_RECORDS)
            peer.offered_at = now
            self._revise_paths(peer, now)

    def set_metered(self, sockets: Iterable[int], now: float) -> None:
        """The sockets whose network is paid by the byte. This hastens no try."""
        self.facts.metered = {*sockets, *self.facts.streams}
        for peer in self.peers.values():
            peer.paths.set_metered()
            self._revise_paths(peer, now)

    def set_rates(self, rates: Mapping[int, float], now: float) -> None:
        """The bits a second that networks with a budget carry at present. Tries and probes follow them."""
        self.facts.set_rates(rates)
        for peer in self.peers.values():
            self._revise_paths(peer, now)

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> None:
        """The network behind a socket disappeared; or it appeared or changed, and its paths have to prove themselves.

        A new connection may lead to a relay that has restarted and knows no session: this node initiates at once.

        The events come with the next :meth:`handle_timeout`, which is due at once.
        """
        for peer in self.peers.values():
            if peer.paths.set_socket_state(socket, now, is_up=is_up) and is_up:
                peer.initiator.hurry(socket, now)
                if socket in self.facts.streams:
                    peer.offered_at = now
            self._revise_paths(peer, now)

    def remove_path(self, path: Path, now: float) -> None:
        """The connection that carried this path has ended: nothing reaches its address any more."""
        for peer in self.peers.values():
            if (state := peer.paths.find(path)) is not None:
                peer.paths.remove(state)
                self._revise_paths(peer, now)

    def _revise_paths(self, peer: Peer, now: float) -> None:
        peer.paths.revise(now)
        if peer.is_up and not peer.paths.by_path and peer.unanswered_since is None:
            peer.unanswered_since = now  # nothing can be sent any more, so no answer can be missed
            peer.timers.set(Timer.SILENCE, now + peer.lost_after_s)
        peer.set_paths_timer()
        peer.set_initiate()
        self.schedule.update(peer)

    # Inputs.

    def send(
        self, peer: Peer, frames: Sequence[bytes], now: float, cls: Class = Class.STREAM, along: Route = ()
    ) -> list[Output]:
        """Send frames of one class that are here together to a peer, as :func:`.send_frames`."""
        out = send_frames(peer, frames, now, cls, along)
        if peer.timers.next_at < peer.timers.scheduled_at:
            self.schedule.update(peer)
        return out

    def report_refusals(self, peer: Peer, changed: Iterable[Refused], now: float) -> list[Output]:
        """Report to the peer which of its frames are refused here: totals that changed since the last call.

        It is sent if there is something new and the peer understands reports. A report expects no answer.
        """
        peer.reports.update_refusals(changed)
        session, route = peer.session_with(c.FEATURE_REFUSALS, now), peer.paths.routes[Class.BULK]
        if session is None or not route or (report := peer.reports.next_refusals(now)) is None:
            return []
        return send_payloads(peer, session, (report.encode(),), route, now, is_answer=True)

    def report_problems(self, peer: Peer, codes: Iterable[int], now: float) -> list[Output]:
        """Report this end's own problems to the peer, if that is due and it understands such reports."""
        session, route = peer.session_with(c.FEATURE_PROBLEMS, now), peer.paths.routes[Class.BULK]
        if session is None or not route:
            return []
        report = peer.reports.next_problems(codes, session.order_base, now)
        return [] if report is None else send_payloads(peer, session, (report.encode(),), route, now, is_answer=True)

    def send_record(self, peer: Peer, path: Path | None, record: Record, now: float) -> list[Output]:
        """Send a record to a relay or to a member along one path, encrypted. It expects no answer from the session.

        Without a path it goes along the best one. Nothing is sent if the path is unknown or does not work and is not
        the best, or if the session does not have such records.
        """
        feature = c.FEATURE_FLEET if isinstance(record, FleetRecord) else c.FEATURE_RECORDS
        session = peer.session_with(feature, now)
        state = peer.paths.best if path is None else peer.paths.find(path)
        if session is None or state is None or not (state.works or state is peer.paths.best):
            return []
        return send_payloads(peer, session, (session.sealed_record(record.encode()),), (state,), now, is_answer=True)

    def ask_candidates(self, peer: Peer, now: float) -> list[Output]:
        """Send a question to each candidate without a slot; to fewer of them if that was done often.

        While that goes on, the best path is asked regularly, also if it is the only one.
        """
        out = ask_candidates(peer, now)
        self.schedule.update(peer)
        return out

    def ask(self, peer: Peer, path: Path, now: float) -> list[Output]:
        """Ask along one path now whether the peer is there. Without an answer in time, the node initiates to it."""
        session, state = peer.sending_session(), peer.paths.find(path)
        if session is None or state is None or state.is_off:
            return []
        out = ask_for_echo(peer, session, now, (state,))
        if peer.paths.has_several:
            out += probing.ask(peer, session, state, now) + probing.update(peer, now)
        self.schedule.update(peer)
        return out

    def handle_timeout(self, now: float) -> list[Output]:
        """Do what is due, for at most :data:`PEERS_AT_ONCE`. Call it at :meth:`next_deadline`, or at any time."""
        out: list[Output] = []
        for _ in range(PEERS_AT_ONCE):
            out += self.handle_next(now)
            if now < self.schedule.next_at:
                break
        return out

    def handle_next(self, now: float) -> list[Output]:
        """Do what is due of the peer whose turn it is: a fault costs no other one its timers or outputs."""
        due = self.schedule.pop(now, 1)
        if not due:
            return []
        (peer,) = due
        if now >= peer.provisional_until:
            return [*self.remove_peer(peer, now), PeerExpired(peer)]
        try:
            out = handle_timeout(peer, now)
        except Exception:
            self._wake(peer, now)
            raise
        self.schedule.update(peer)
        return out

    def next_deadline(self) -> float:
        """When :meth:`handle_timeout` is to be called next; infinity for never."""
        return self.schedule.next_at

    def close(self, now: float) -> list[Output]:
        """Close the sessions with every peer, first those along a relay: its own close ends their handles."""
        out: list[Output] = []
        for peer in sorted(self.peers.values(), key=lambda peer: peer.path is None or not peer.path.is_relayed):
            out += establish.close(peer, now)
            self.schedule.remove(peer)
        return out

    # For a busy shell.

    def pop_held(self) -> list[Output]:
        """Hold no frames any more that wait for a proof of freshness, or for others.

        Only for a shell that drops them: this process stood still, and they may be from before that.
        """
        return [
            Deliver(peer, payload)
            for peer in self.peers.values()
            for session in peer.sessions.confirmed
            for payload in session.held.pop_all()
        ] + [
            frames for peer in self.peers.values() if peer.early is not None for frames in peer.early.release(c.NEVER)
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

    def screen(self, datagram: bytes, path: Path, now: float) -> Dropped | None:
        """Drop a datagram that is not an envelope, unless it passes the checks that come before a key exchange.

        A busy shell lets only those that pass wait.
        """
        try:
            self._handshakes.screen(datagram, path, now)
        except Drop as drop:
            return self._count(datagram, drop, path)
        return None

    def handshake_source(self, datagram: bytes, path: Path, now: float) -> Hashable | None:
        """What tells screened handshake messages apart that wait: a newer one supersedes one that is equal.

        Initiations along one path are equal, unless only one of them has a cookie: a forgery
        without it does not supersede the other one. None: the message costs little, and does not wait.
        """
        return self._handshakes.source_of(datagram, path, now)

    def initiations_from(self, path: Path) -> list[Hashable]:
        """All that :meth:`handshake_source` returns for initiations along a path that are for us."""
        return self._handshakes.initiations_from(path)

    def refuse(self, datagram: bytes, path: Path) -> Dropped:
        """Count a datagram that a busy shell does not hand over: more wait than their share."""
        return self._count(datagram, Drop(DropReason.OVER_SHARE), path)

    # Where peers are.

    def _is_known(self, address: SocketAddress) -> bool:
        """Whether a peer is configured at an address, or was last seen there."""
        return address in self._by_address or address in self._last_seen

    def _forget_addresses(self, peer: Peer) -> None:
        for path in peer.paths.configured:
            if self._by_address.get(path.place) is peer:
                del self._by_address[path.place]
