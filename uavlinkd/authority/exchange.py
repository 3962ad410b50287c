"""How bulletins reach the peers of one daemon. README.md, "Bulletins".

Each end states what it has when a session begins and when that changes; the end with the newer one sends it, until
the other states that it has it. The static public key of a peer names it. Pure: no I/O, no clock, no random source of
its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from uavlinkd.authority import constants as c
from uavlinkd.authority.trust import BulletinVerdict, Trust
from uavlinkd.protocol.crypto import Entropy
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.relay_records import BulletinRecord, FleetRecord, Have

ROLLED_BACK = "bulletin_rolled_back"
"""A peer has an older bulletin than it had before: its disk was restored."""


class Reaction(NamedTuple):
    """What the daemon does because of a record, in this order."""

    ended: tuple[bytes, ...] = ()
    """The peers with these keys end at once, without a close. The exchange has forgotten them."""
    persists: bool = False
    """The bulletin is to be written, then :meth:`BulletinExchange.note_persisted`."""
    event: str = ""
    """For the log: ``bulletin_conflict``, ``bulletin_shrinks`` or ``bulletin_rolled_back``."""


@dataclass(slots=True)
class _Peer:
    """What one peer stated, and when it gets what. Kept while it is down: it may come back with an older disk."""

    is_up: bool = False
    have: Have | None = None  # what it stated last, on the present link; with a bulletin that it sent since
    stated: int | None = None  # the number that it stated last, ever
    order: int = -1  # of the record that stated it
    push_at: float = inf
    pushed_at: float = -inf
    tries: int = 0
    owes_have: bool = False  # whether this end has to state what it has
    have_sent_at: float = -inf
    verified_at: float = -inf

    @property
    def next_at(self) -> float:
        """When it may get something. The answer to a *have* or a bulletin waits for the next one at least."""
        return min(self.push_at, self.have_sent_at + c.HAVE_LEAST_S if self.owes_have else inf)


class BulletinExchange:
    """The exchange of one daemon with its peers that have ``FEATURE_FLEET``. Times are monotonic seconds.

    Look at :attr:`next_at` after each call: :meth:`do_due` alone returns records to send.

    ``trust``: its bulletin is on the disk. ``wait_s``: how long the answer to a bulletin for the peer with this key
    may take, at least.
    """

    def __init__(self, trust: Trust, entropy: Entropy, wait_s: Callable[[bytes], float] = lambda _: 0.0) -> None:
        self._trust = trust
        self._entropy = entropy
        self._answer_s = wait_s
        self._persisted = (trust.bulletin.number, trust.digest)
        self._peers: dict[bytes, _Peer] = {}
        self.next_at = inf
        """When :meth:`do_due` has something to do, or sooner."""

    # Peers.

    def on_handshake(self, key: bytes, now: float) -> None:
        """A session with the peer that has this static public key was made, or its link is up again."""
        peer = self._peers.setdefault(key, _Peer())
        if not peer.is_up:
            peer.is_up, peer.have, peer.tries = True, None, 0
        peer.owes_have, peer.push_at = True, min(peer.push_at, now + self._wait_s(key))
        self._note(peer)

    def on_down(self, key: bytes) -> None:
        """The link of a peer is lost or closed."""
        if (peer := self._peers.get(key)) is not None:
            peer.is_up, peer.push_at, peer.owes_have = False, inf, False

    def forget(self, key: bytes) -> None:
        """The peer was removed."""
        self._peers.pop(key, None)

    def shown(self, key: bytes) -> int | None:
        """The number of the newest bulletin that a peer has, as far as is known; None if it did not state any."""
        peer = self._peers.get(key)
        if peer is None:
            return None
        return peer.stated if peer.have is None else peer.have.number

    def serial(self, key: bytes) -> int | None:
        """The serial of its own certificate that a peer stated on the present link; 0 if it has none."""
        peer = self._peers.get(key)
        return None if peer is None or peer.have is None else peer.have.serial

    # Receipt.

    def receive(self, key: bytes, record: FleetRecord, order: int, now: float) -> Reaction:
        """A peer sent *have* or a bulletin.

        ``order``: that of :class:`~uavlinkd.protocol.outputs.RecordReceived`. Raises Drop if the record has no
        effect.
        """
        peer = self._peers.get(key)
        if peer is not None and peer.is_up:
            if isinstance(record, Have):
                return self._receive_have(key, peer, record, order, now)
            if isinstance(record, BulletinRecord):
                return self._receive_bulletin(peer, record.bulletin, now)
        raise Drop(DropReason.UNEXPECTED_RECORD)

    def _receive_have(self, key: bytes, peer: _Peer, have: Have, order: int, now: float) -> Reaction:
        if order <= peer.order:
            raise Drop(DropReason.OLD_RECORD)
        is_repeated = have == peer.have
        is_rolled_back = peer.stated is not None and have.number < peer.stated
        peer.order, peer.have, peer.stated = order, have, have.number
        if not is_repeated:
            peer.tries = 0
        wait_s, own = self._wait_s(key), self._trust.bulletin.number
        if have.number < own:
            peer.push_at = max(now, peer.pushed_at + wait_s)
        elif have.number > own:
            peer.push_at = min(peer.push_at, now + wait_s)
        else:
            peer.push_at = inf
            # The peer may not know what this end has. The peer's answer to the answer comes too soon for a loop.
            peer.owes_have |= now >= peer.have_sent_at + wait_s
        self._note(peer)
        if is_rolled_back:
            return Reaction(event=ROLLED_BACK)
        return Reaction(event="" if is_repeated else self._conflict([peer]))

    def _receive_bulletin(self, peer: _Peer, data: bytes, now: float) -> Reaction:
        may_verify = now >= peer.verified_at + c.BULLETIN_LEAST_S
        verdict, ended = self._trust.receive_bulletin(data, may_verify=may_verify)
        if verdict is BulletinVerdict.UNVERIFIED:
            raise Drop(DropReason.RECORD_OVER_LIMIT)
        if verdict is not BulletinVerdict.KNOWN:
            peer.verified_at = now
        if verdict is BulletinVerdict.INVALID:
            raise Drop(DropReason.BAD_CONTROL)
        peer.owes_have |= self._persisted[0] == self._trust.bulletin.number  # else when it is written
        self._note(peer)
        if peer.have is not None and data == self._trust.bulletin_bytes:
            peer.have = peer.have._replace(number=self._trust.bulletin.number, digest=self._trust.digest)
        if verdict is BulletinVerdict.NEWER:
            return self._accepted(ended, now)
        return Reaction(event="" if verdict is BulletinVerdict.KNOWN else verdict.value)

    def publish(self, data: bytes, now: float) -> tuple[BulletinVerdict, Reaction]:
        """Take a bulletin from the operator, as if a peer had sent it."""
        verdict, ended = self._trust.receive_bulletin(data)
        return verdict, self._accepted(ended, now) if verdict is BulletinVerdict.NEWER else Reaction()

    def _accepted(self, ended: list[bytes], now: float) -> Reaction:
        """Send each peer the new bulletin, a little later: it may come from others until then."""
        for key in ended:
            self.forget(key)
        for key, peer in self._peers.items():
            if peer.is_up:
                soon = now + c.PUSH_JITTER_S * self._entropy(1)[0] / 255
                peer.tries, peer.push_at = 0, max(soon, peer.pushed_at + self._wait_s(key))
                self._note(peer)
        return Reaction(tuple(ended), persists=True, event=self._conflict(self._peers.values()))

    def _conflict(self, peers: Iterable[_Peer]) -> str:
        """The event if one of these stated the own number with another digest."""
        own = self._trust.bulletin.number, self._trust.digest
        stated = [peer.have for peer in peers if peer.have is not None]
        is_other = any(have.number == own[0] and have.digest != own[1] for have in stated)
        return BulletinVerdict.CONFLICT.value if is_other else ""

    def note_persisted(self, number: int, digest: bytes) -> None:
        """The bulletin with this number is on the disk. Before, no *have* states it."""
        self._persisted = number, digest
        for peer in self._peers.values():
            peer.owes_have |= peer.is_up
            self._note(peer)

    def _wait_s(self, key: bytes) -> float:
        """How long to wait for an answer of a peer before a repetition."""
        return max(self._answer_s(key), c.PUSH_AGAIN_S)

    def _note(self, peer: _Peer) -> None:
        self.next_at = min(self.next_at, peer.next_at)

    # Sending.

    def do_due(self, now: float) -> list[tuple[bytes, FleetRecord]]:
        """The records to send now, each with the key of its receiver.

        A peer that is behind gets the bulletin. One that stated nothing yet, or is ahead, gets *have*, which asks it.
        """
        sent: list[tuple[bytes, FleetRecord]] = []
        own = self._trust.bulletin.number
        for key, peer in self._peers.items():
            if peer.push_at <= now:
                is_behind = peer.have is not None and peer.have.number < own
                is_asked = peer.have is None or peer.have.number > own
                if is_behind:
                    sent.append((key, BulletinRecord(self._trust.bulletin_bytes)))
                    peer.pushed_at = now
                peer.owes_have |= is_asked
                peer.tries += 1
                least_s = 0.0 if peer.tries < c.PUSH_TRIES else c.HAVE_INTERVAL_S
                peer.push_at = now + max(least_s, self._wait_s(key)) if is_behind or is_asked else inf
            if peer.owes_have and now >= peer.have_sent_at + c.HAVE_LEAST_S:
                sent.append((key, self._have(key)))
                peer.owes_have, peer.have_sent_at = False, now
        self.next_at = min((peer.next_at for peer in self._peers.values()), default=inf)
        return sent

    def _have(self, key: bytes) -> Have:
        own, held = self._trust.own, self._trust.held.get(key)
        serials = (0 if one is None else one.certificate.serial for one in (own, held))
        return Have(*self._persisted, *serials)
