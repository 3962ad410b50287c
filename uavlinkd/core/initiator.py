"""The own initiations to one peer: when and where they go, and what may still answer them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.cookie import MacKeys, mac1_of
from uavlinkd.core.crypto import Entropy, KeyPair
from uavlinkd.core.handshake import Initiated, Keys
from uavlinkd.core.indices import Indices
from uavlinkd.core.kem import OneCiphertext
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings


@dataclass(slots=True)
class Pending:
    """An own initiation that may still be answered."""

    initiated: Initiated
    mac1: bytes
    """Of the initiation; a cookie reply refers to it."""
    path: Path
    expires_at: float
    has_cookie: bool = False
    """Whether a cookie reply to it was accepted: a second one is not."""
    once: OneCiphertext | None = field(init=False, default=None)
    """The secret for its suite's group, which a response may use; None without a group."""

    def __post_init__(self) -> None:
        if (key := self.initiated.state.e1) is not None:
            self.once = OneCiphertext(key)


class Initiator:
    """Initiates to one peer, at growing intervals, at each of its addresses in turn, indefinitely.

    Each try has fresh keys. Several stay answerable, so that a response over a slow path still finds its initiation.
    """

    def __init__(
        self, settings: PeerSettings, identity: KeyPair, indices: Indices[object], entropy: Entropy, now: float
    ) -> None:
        self.paths: tuple[Path, ...] = ()
        """Where the configuration says that the peer is."""
        self.pending: dict[int, Pending] = {}
        """By our index, the oldest first."""
        self.retry_at = now
        """No initiation is sent earlier, however much new keys are wanted."""
        self.attempts = 0
        """Initiations since new keys were wanted."""
        self._settings = settings
        self._identity = identity
        self._indices = indices
        self._entropy = entropy
        self._mac_keys = MacKeys(settings.public_key)
        self.initiated_at = -c.NEVER
        """When the last initiation was sent."""
        self._received_cookies: dict[Path, tuple[bytes, float]] = {}  # the peer's, and until when; the oldest first

    def next_path(self, candidates: list[Path], now: float) -> Path:
        """Where the next initiation goes. Schedules the one after it."""
        path = candidates[self.attempts % len(candidates)]
        timers = self._settings.link.timers
        # Bounded before the power is taken: a peer may stay away for years.
        doublings = min(self.attempts // c.RETRIES_PER_WAIT, 32)
        wait = min(timers.retry_min_s * 2.0**doublings, timers.retry_max_s)
        # Where there are several addresses, each has its turn as often as a single one would, down to the first wait.
        wait = max(wait / len(candidates), timers.retry_min_s)
        jitter = c.RETRY_JITTER * int.from_bytes(self._entropy(2), "big") / 2**16
        self.attempts += 1
        self.initiated_at = now
        self.retry_at = now + wait * (1.0 + jitter)
        return path

    def initiate(self, index: int, path: Path, generation: int, now: float) -> tuple[Pending, bytes]:
        """An initiation under this index, and its datagram."""
        initiated = handshake.initiate(self._identity, self._settings, index, generation, self._entropy)
        datagram = self.add_macs(initiated.message, path, now)
        while len(self.pending) >= c.PENDING_PER_PEER:
            self._forget(next(iter(self.pending)))
        pending = self.pending[index] = Pending(initiated, mac1_of(datagram), path, now + c.PENDING_LIFETIME_S)
        return pending, datagram

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

        A cookie proves one address of ours. With several, such as one for IPv4 and one for IPv6, it is valid on that
        ``path`` alone.

        Raises:
            Drop: ``BAD_COOKIE``.
        """
        cookie = self._mac_keys.open_cookie(reply, mac1)
        self._received_cookies.pop(path, None)
        while len(self._received_cookies) >= c.COOKIES_PER_PEER:
            del self._received_cookies[next(iter(self._received_cookies))]
        self._received_cookies[path] = cookie, now + c.COOKIE_HELD_S
        # Anyone who sees our datagrams can make a cookie, so it may not make us send faster than the first retry.
        soon = max(now, self.initiated_at + self._settings.link.timers.retry_min_s)
        self.retry_at = min(self.retry_at, soon)

    def add_macs(self, message: bytes, path: Path, now: float) -> bytes:
        """A handshake message to the peer with its macs, under the cookie for this path while there is one."""
        cookie, held_until = self._received_cookies.get(path, (None, now))
        return self._mac_keys.add_macs(message, cookie if now < held_until else None)

    def reset(self) -> None:
        """No new keys are wanted now: the next initiation is repeated after the shortest wait."""
        self.attempts = 0

    def cancel(self) -> None:
        """Accept no response to what was sent so far."""
        for index in list(self.pending):
            self._forget(index)

    def expire(self, now: float) -> None:
        """Forget initiations that got no response."""
        for index in [index for index, pending in self.pending.items() if now >= pending.expires_at]:
            self._forget(index)

    def next_expiry(self) -> float:
        """When :meth:`expire` has something to do."""
        return min((pending.expires_at for pending in self.pending.values()), default=c.NEVER)

    def _forget(self, index: int) -> None:
        del self.pending[index]
        self._indices.forget(index)
