"""Handshake messages, the cheapest check first. README.md, sections 7 and 13."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, handshake, wire
from uavlinkd.protocol.admission import Admission, CookieRequired, Message
from uavlinkd.protocol.cookie import CookieJar, mac1_of, version_of
from uavlinkd.protocol.crypto import KeyPair, equal
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.initiator import Pending
from uavlinkd.protocol.outputs import CertificateShown, Output
from uavlinkd.protocol.path import Path, SocketFacts
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Indices
from uavlinkd.protocol.timers import Schedule

_MAVLINK_STARTS = frozenset((0xFD, 0xFE))
_NOT_OUR_VERSION = frozenset((DropReason.MALFORMED, DropReason.BAD_MAC1))


@dataclass(slots=True)
class Remembered:
    """An authentic initiation that was read, to recognise its copies."""

    peer: Peer
    mac1: bytes
    read_at: float
    late_copies: int = 0
    """How often it came again while no session waited for its confirmation."""


class ShownInitiation(NamedTuple):
    """An authentic initiation that waits for its answer."""

    received: handshake.Received
    message: Message


class HandshakeReceiver:
    """Decides which handshake messages are read, and passes them to the peer that sent them.

    ``identity``: the static key of this daemon.
    """

    def __init__(
        self,
        identity: KeyPair,
        cookies: CookieJar,
        indices: Indices[tuple[Peer, Session | Pending]],
        admission: Admission,
        facts: SocketFacts,
        schedule: Schedule[Peer],
    ) -> None:
        self.identity = identity
        self.cookies = cookies
        self.admission = admission
        self.peers: dict[bytes, Peer] = {}
        """By their public key."""
        self.remembered: dict[bytes, Remembered] = {}
        """By the ephemeral of the initiation."""
        self.takes_certificates = False
        self._indices = indices
        self._facts = facts
        self._schedule = schedule

    def screen(self, datagram: bytes, path: Path, now: float) -> None:
        """The checks of a datagram that is not an envelope, up to its mac1. What passes may wait for a key exchange.

        Raises Drop.
        """
        kind = datagram[0] if datagram else 0
        if kind == wire.INITIATION:
            self.admission.read(path, now)  # before any work: a flood costs no more than this
            try:
                wire.parse_initiation(datagram)
                self._check_mac1(datagram)
            except Drop as drop:
                self._name_version(drop.reason, datagram, path, now)
                raise
        elif kind == wire.RESPONSE:
            self._find_pending(wire.parse_response(datagram), path)
            self._check_mac1(datagram)
        elif kind != wire.COOKIE:
            raise Drop(DropReason.RAW_MAVLINK if kind in _MAVLINK_STARTS else DropReason.MALFORMED)

    def receive(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        """What to do about a datagram that passed :meth:`screen`.

        Raises Drop: in particular :class:`.admission.CookieRequired`, with a reply to the sender.
        """
        if datagram[0] == wire.INITIATION:
            return self._receive_initiation(datagram, path, now)
        if datagram[0] == wire.RESPONSE:
            return self._receive_response(datagram, path, now)
        return self._receive_cookie(datagram, path, now)

    def source_of(self, datagram: bytes, path: Path, now: float) -> Hashable | None:
        """Equal for initiations along one path with a cookie, or without. None: it costs little."""
        kind = datagram[0]
        if kind == wire.COOKIE:
            return None
        return path, (datagram if kind == wire.RESPONSE else self.cookies.has_valid_mac2(datagram, path, now))

    def initiations_from(self, path: Path) -> list[Hashable]:
        """All that :meth:`source_of` returns for initiations along a path."""
        return [(path, has_cookie) for has_cookie in (False, True)]

    def remember(self, peer: Peer, ephemeral: bytes, mac1: bytes, now: float) -> None:
        """An authentic initiation of this peer came, with this ephemeral."""
        # A memory for each peer: no peer can make us forget what another sent.
        self.remembered[ephemeral] = Remembered(peer, mac1, now)
        peer.remembered.append(ephemeral)
        share = c.REMEMBERED_INITIATIONS // max(1, len(self.peers))
        while len(peer.remembered) > min(c.REMEMBERED_MOST, max(c.REMEMBERED_LEAST, share)):
            self.remembered.pop(peer.remembered.popleft(), None)

    def forget(self, peer: Peer) -> None:
        """Accept nothing from this peer any more."""
        del self.peers[peer.settings.public_key]
        for ephemeral in peer.remembered:
            self.remembered.pop(ephemeral, None)

    # Parts.

    def _receive_initiation(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        initiation = wire.parse_initiation(datagram)
        remembered = self.remembered.get(initiation.ephemeral)
        if remembered is not None:  # before the budget: one recording must not use it up
            self._facts.check_network(remembered.peer, path)
            return self._answer_copy(remembered, datagram, path, now)
        message = Message(datagram, initiation.sender_index, path, self.cookies)
        self.admission.admit(message, now, is_response=False)
        received = handshake.receive_initiation(self.identity, initiation)
        peer = self.peers.get(received.public_key)
        if received.certificate and self.takes_certificates and (peer is None or peer.settings.is_certified):
            shown = ShownInitiation(received, message)
            return [CertificateShown(received.public_key, received.certificate, path, shown)]
        if peer is None:
            raise Drop(DropReason.UNKNOWN_PEER, received.public_key)
        return self.answer(peer, ShownInitiation(received, message), now)

    def answer(self, peer: Peer, initiation: ShownInitiation, now: float) -> list[Output]:
        """Answer an authentic initiation of this peer. Raises Drop: along another peer's network."""
        received, message = initiation
        path = message.path
        # Before it is remembered: otherwise a line could use up what this peer sends along its own network.
        self._facts.check_network(peer, path)
        self.remember(peer, received.initiation.ephemeral, mac1_of(message.datagram), now)
        try:
            out = self._answer(peer, received, message, now)
        except CookieRequired as drop:
            return [drop.reply, peer.drop_datagram(drop.reason, path)]
        except Drop as drop:
            return [peer.drop_datagram(drop.reason, path, drop.detail)]
        self._schedule.update(peer)
        return out

    def _answer_copy(self, remembered: Remembered, datagram: bytes, path: Path, now: float) -> list[Output]:
        """An initiation that was read before: its peer sends it along several paths, and one may be slow."""
        peer = remembered.peer
        if not equal(remembered.mac1, mac1_of(datagram)):
            raise Drop(DropReason.REPLAYED_INITIATION)
        for waiting in peer.sessions.unconfirmed.values():
            if waiting.initiation_mac1 == remembered.mac1:
                out = establish.answer_copy(peer, waiting, path, now)
                return [*out, peer.drop_datagram(DropReason.DUPLICATE, path)]
        remembered.late_copies += 1
        if now >= remembered.read_at + c.INITIATION_COPIES_S or remembered.late_copies >= c.COPIES_OF_A_RESPONSE:
            raise Drop(DropReason.REPLAYED_INITIATION)
        return [peer.drop_datagram(DropReason.DUPLICATE, path)]

    def _answer(self, peer: Peer, received: handshake.Received, message: Message, now: float) -> list[Output]:
        suite = received.initiation.suite
        self.admission.admit_answer(peer, message, now)
        if suite not in peer.settings.link.suites:
            raise Drop(DropReason.SUITE_NOT_ACCEPTED, suite.name)
        if suite.has_group:
            self.admission.admit_group(peer, suite, message, now)
        return establish.answer(peer, received, message.datagram, message.path, now)

    def _receive_response(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        response = wire.parse_response(datagram)
        peer, pending = self._find_pending(response, path)  # again: another response may have come meanwhile
        message = Message(datagram, response.sender_index, path, self.cookies)
        self.admission.admit(message, now, is_response=True)
        out = establish.receive_response(peer, pending, response, path, now)
        self._schedule.update(peer)
        return out

    def _find_pending(self, response: wire.Response, path: Path) -> tuple[Peer, Pending]:
        """The initiation that a response answers, and its peer."""
        peer, pending = self._indices.owners.get(response.receiver_index, (None, None))
        if peer is None or not isinstance(pending, Pending):
            # The peer sends its response along several paths; the first one made the session.
            is_copy = isinstance(pending, Session) and pending.remote_index == response.sender_index
            raise Drop(DropReason.DUPLICATE if is_copy else DropReason.UNEXPECTED_RESPONSE)
        self._facts.check_network(peer, path)
        return peer, pending

    def _receive_cookie(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        reply = wire.parse_cookie_reply(datagram)
        peer, owner = self._indices.owners.get(reply.receiver_index, (None, None))
        if peer is None:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        asked = owner if isinstance(owner, Pending) else peer.sessions.unconfirmed.get(reply.receiver_index)
        # One for each message and path: an observer can make more, but has to be faster than the peer each time.
        if asked is None or path not in asked.paths or path in asked.cookied:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        peer.initiator.receive_cookie(asked.mac1, path, reply, now)
        asked.cookied.add(path)
        peer.traffic.cookies_taken += 1
        peer.set_initiate()
        self._schedule.update(peer)
        return []

    def _check_mac1(self, datagram: bytes) -> None:
        """Raise ``BAD_MAC1`` if a handshake message is not for this daemon's key."""
        if not self.cookies.keys.has_valid_mac1(datagram):
            raise Drop(DropReason.BAD_MAC1)

    def _name_version(self, reason: DropReason, datagram: bytes, path: Path, now: float) -> None:
        """Raise ``OTHER_VERSION`` if it is one: it may have other lengths, and has another label of mac1."""
        if reason not in _NOT_OUR_VERSION or not self.admission.may_compare_versions(path, now):
            return
        if (version := version_of(datagram, self.identity.public)) is not None:
            raise Drop(DropReason.OTHER_VERSION, version)
