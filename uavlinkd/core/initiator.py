"""Calling a peer: our initiations, when and where they go, and what may still answer them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.cookie import MacKeys, mac1_of
from uavlinkd.core.crypto import Entropy, KeyPair
from uavlinkd.core.handshake import Initiated, Keys
from uavlinkd.core.indices import Indices
from uavlinkd.core.kem import OneCiphertext
from uavlinkd.core.outputs import Path, Transmit
from uavlinkd.core.settings import PeerSettings

if TYPE_CHECKING:
    from uavlinkd.core.peer import Peer


@dataclass(slots=True)
class Pending:
    """An initiation of ours that may still be answered."""

    peer: Peer
    initiated: Initiated
    mac1: bytes
    """Of the initiation, which a cookie reply refers to."""
    path: Path
    expires_at: float
    has_cookie: bool = False
    """Whether one came for it: a second is not taken."""
    once: OneCiphertext | None = field(init=False, default=None)
    """The secret for its suite's group, which a response may use; None without a group."""

    def __post_init__(self) -> None:
        if (key := self.initiated.state.e1) is not None:
            self.once = OneCiphertext(key)


class Caller:
    """Initiates to one peer, at growing intervals, at each of its addresses in turn, for ever.

    Each try has fresh keys. Several stay answerable, so that a response over a slow path still finds its initiation.
    """

    def __init__(
        self,
        peer: Peer,
        settings: PeerSettings,
        identity: KeyPair,
        indices: Indices,
        entropy: Entropy,
        now: float,
    ) -> None:
        self.addresses: tuple[Path, ...] = ()
        """Where the configuration says that the peer is."""
        self.pending: dict[int, Pending] = {}
        """By our index, the oldest first."""
        self.retry_at = now
        """Not before this, however much new keys are wanted."""
        self._peer = peer
        self._settings = settings
        self._identity = identity
        self._indices = indices
        self._entropy = entropy
        self._mac_keys = MacKeys(settings.public_key)
        self._attempt = 0
        self._called_at = -c.NEVER
        self._taken_cookies: dict[Path, tuple[bytes, float]] = {}  # and until when; the oldest first

    def candidates(self, path: Path | None) -> list[Path]:
        """Where the peer may be: the path in use first, then its addresses."""
        return [*([path] if path else []), *(each for each in self.addresses if each != path)]

    def call(self, path: Path | None, generation: int, now: float) -> Transmit | None:
        """The next initiation; None where no address is known.

        Raises:
            Drop: ``NO_FREE_INDEX``; the next try comes as after any other.
        """
        candidates = self.candidates(path)
        if not candidates:
            return None
        to = candidates[self._attempt % len(candidates)]
        self._schedule(len(candidates), now)
        if self._attempt and self._peer.is_up:
            self._peer.traffic.handshakes_unanswered += 1
        self._attempt += 1

        index = self._indices.pick(now)
        initiated = handshake.initiate(self._identity, self._settings, index, generation, self._entropy)
        datagram = self.add_macs(initiated.message, to, now)
        while len(self.pending) >= c.PENDING_PER_PEER:
            self._forget(next(iter(self.pending)))
        pending = Pending(self._peer, initiated, mac1_of(datagram), to, now + c.PENDING_LIFETIME_S)
        self.pending[index] = self._indices.owners[index] = pending
        return Transmit(datagram, to)

    def receive_response(self, pending: Pending, response: wire.Response) -> Keys:
        """The keys of the session that this response makes. Its index is not free: it is the session's now.

        Raises:
            Drop: as :func:`handshake.receive_response`; then the genuine response can still come.
        """
        state = replace(pending.initiated.state, e1=pending.once)
        keys = handshake.receive_response(pending.initiated._replace(state=state), response)
        del self.pending[response.receiver_index]
        return keys

    def receive_cookie(self, mac1: bytes, path: Path, reply: wire.CookieReply, now: float) -> None:
        """The peer is under load: keep its cookie, and try again soon.

        A cookie proves one address of ours: where we have several, as towards IPv4 and IPv6, it is good on that
        ``path`` alone.

        Raises:
            Drop: ``BAD_COOKIE``.
        """
        cookie = self._mac_keys.open_cookie(reply, mac1)
        self._taken_cookies.pop(path, None)
        while len(self._taken_cookies) >= c.COOKIES_PER_PEER:
            del self._taken_cookies[next(iter(self._taken_cookies))]
        self._taken_cookies[path] = cookie, now + c.COOKIE_HELD_S
        self._peer.traffic.cookies_taken += 1
        # Anyone who sees our datagrams can make a cookie, so it may not make us send faster than the first retry.
        soon = max(now, self._called_at + self._settings.link.timers.retry_min_s)
        self.retry_at = min(self.retry_at, soon)

    def add_macs(self, message: bytes, path: Path, now: float) -> bytes:
        """A handshake message to the peer with its macs, under the cookie for this path while there is one."""
        cookie, held_until = self._taken_cookies.get(path, (None, now))
        return self._mac_keys.add_macs(message, cookie if now < held_until else None)

    def rest(self) -> None:
        """No new keys are wanted now: the next call begins with the shortest wait."""
        self._attempt = 0

    def cancel(self) -> None:
        """Take no answer to what was sent so far."""
        for index in list(self.pending):
            self._forget(index)

    def expire(self, now: float) -> None:
        """Forget initiations that nobody answered."""
        for index in [i for i, each in self.pending.items() if now >= each.expires_at]:
            self._forget(index)

    def next_expiry(self) -> float:
        """When :meth:`expire` has something to do."""
        return min((each.expires_at for each in self.pending.values()), default=c.NEVER)

    def _schedule(self, candidates: int, now: float) -> None:
        timers = self._settings.link.timers
        # Bounded before the power is taken: a peer may stay away for years.
        doublings = min(self._attempt // c.RETRIES_PER_WAIT, 32)
        wait = min(timers.retry_min_s * 2.0**doublings, timers.retry_max_s)
        # Where there are several addresses, each has its turn as often as a single one would, down to the first wait.
        wait = max(wait / candidates, timers.retry_min_s)
        jitter = c.RETRY_JITTER * int.from_bytes(self._entropy(2), "big") / 2**16
        self._called_at = now
        self.retry_at = now + wait * (1.0 + jitter)

    def _forget(self, index: int) -> None:
        del self.pending[index]
        self._indices.forget(index)
