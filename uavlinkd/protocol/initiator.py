"""The own initiations to one peer: when and where they go, and what may still answer them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.crypto import Entropy, KeyPair
from uavlinkd.protocol.handshake import Initiated, Keys
from uavlinkd.protocol.path import Path, SocketFacts
from uavlinkd.protocol.sessions import Indices
from uavlinkd.protocol.settings import PeerSettings


@dataclass(slots=True)
class Pending:
    """An own initiation that may still be answered."""

    initiated: Initiated
    mac1: bytes
    """Of the initiation; a cookie reply refers to it."""
    paths: tuple[Path, ...]
    """Where it was sent, the best first."""
    sent_at: float
    expires_at: float
    is_slow: bool = False
    """Whether it was sent along a slow network: its response may take as long as several tries along others."""
    cookied: set[Path] = field(default_factory=set)
    """Paths along which a cookie reply to it was accepted: a second one is not."""


class Initiator:
    """Initiates to one peer, at growing intervals, along all of its paths, indefinitely.

    Each try has fresh keys. Several stay answerable, so that a response over a slow path still finds its initiation.
    """

    def __init__(
        self,
        settings: PeerSettings,
        identity: KeyPair,
        indices: Indices[object],
        entropy: Entropy,
        facts: SocketFacts,
        now: float,
    ) -> None:
        self.pending: dict[int, Pending] = {}
        """By our index, the oldest first."""
        self.retry_at = now
        """No initiation is sent earlier, however much new keys are wanted."""
        self.attempts = 0
        """Initiations since new keys were wanted; 0: the next one is repeated after the shortest wait."""
        self.settings = settings
        self._identity = identity
        self._indices = indices
        self._entropy = entropy
        self._facts = facts
        self._mac_keys = MacKeys(settings.public_key)
        self.certificate = b""
        """Of this daemon: it shows it to a peer by certificate. Empty for others."""
        self.is_known = False
        """Whether the peer confirmed a session, and so holds the certificate, unless it restarted."""
        self.initiated_at = -c.NEVER
        """When the last initiation was sent."""
        self._began_at = now  # the first of the tries since new keys were wanted
        self._due_at: dict[int, float] = {}  # by socket of a network with a budget, or metered: the next try there
        self._received_cookies: dict[Path, tuple[bytes, float]] = {}  # the peer's, and until when; the oldest first

    def take(self, paths: Sequence[Path], shown: bytes, now: float) -> tuple[list[Path], float]:
        """The paths, of these, along which to initiate now, and when the next try is due if none of them is free.

        Tries along a network with a budget are :data:`c.TRY_AIRTIMES` airtimes apart, those along a metered one are
        the rarer the longer the peer does not answer, whatever other networks do. ``shown``: the certificate in this
        initiation.
        """
        taken: list[Path] = []
        due_at, sockets = c.NEVER, set[int]()
        for path in paths:
            interval_s = max(self._slow_interval_s(path, shown), self._metered_interval_s(path, now))
            if not interval_s:
                due_at = now
            elif path.socket in sockets or now >= self._due_at.get(path.socket, now):
                sockets.add(path.socket)
                self._due_at[path.socket] = now + interval_s * self._jitter()
            else:
                due_at = min(due_at, self._due_at[path.socket])
                continue
            taken.append(path)
        return taken, min([due_at, *(self._due_at[socket] for socket in sockets)])

    def _slow_interval_s(self, path: Path, shown: bytes) -> float:
        """Between tries along a path of a network with a budget; 0 if it carries the usual ones."""
        interval_s = self._facts.try_interval_s(path, self.settings.link.suites[0], len(shown))
        return interval_s if interval_s > self.settings.link.timers.retry_min_s else 0.0

    def _metered_interval_s(self, path: Path, now: float) -> float:
        """Between tries along a path of a metered network; 0 while the peer has not been silent for long."""
        if path.socket not in self._facts.metered or not self.attempts:
            return 0.0
        silent_s = now - self._began_at
        return max((wait_s for after_s, wait_s in c.METERED_RETRIES if silent_s >= after_s), default=0.0)

    def shown(self, *, is_answering: bool) -> bytes:
        """The certificate, if the next attempt shows it. A peer that does not answer may have restarted."""
        return b"" if self.is_known and is_answering else self.certificate

    def _jitter(self) -> float:
        return 1.0 + c.RETRY_JITTER * int.from_bytes(self._entropy(2), "big") / 2**16

    def begin_try(self, now: float, due_at: float = 0.0) -> None:
        """An initiation is to be sent now. Schedules the one after it, not before ``due_at``: see :meth:`take`."""
        if not self.attempts:
            self._began_at = now
        timers = self.settings.link.timers
        # Bounded before the power is taken: a peer may stay away for years.
        doublings = min(self.attempts // c.RETRIES_PER_WAIT, 32)
        wait = min(timers.retry_min_s * 2.0**doublings, timers.retry_max_s)
        self.attempts += 1
        self.initiated_at = now
        self.retry_at = max(now + wait * self._jitter(), due_at)

    def initiate(
        self, index: int, paths: Sequence[Path], generation: int, shown: bytes, now: float
    ) -> tuple[Pending, list[tuple[bytes, Path]]]:
        """An initiation under this index, and its datagram for each path. They are equal up to mac1."""
        initiated = handshake.initiate(self._identity, self.settings, index, generation, self._entropy, shown)
        datagrams = [(self.add_macs(initiated.message, path, now), path) for path in paths]
        mac1 = mac1_of(datagrams[0][0])
        slowest_s = max(self._slow_interval_s(path, shown) for path in paths)
        expires_at = now + max(c.PENDING_LIFETIME_S, slowest_s)
        while len(self.pending) >= c.PENDING_PER_PEER:
            # Fast tries along one network must not push out the one that a slow network still carries.
            fast = (old for old, waiting in self.pending.items() if not waiting.is_slow)
            self._forget(next(fast, next(iter(self.pending))))
        pending = self.pending[index] = Pending(initiated, mac1, tuple(paths), now, expires_at, slowest_s > 0)
        return pending, datagrams

    def receive_response(self, pending: Pending, response: wire.Response) -> Keys:
        """The keys of the session that this response makes. Its index is not free: it is the session's now.

        Raises Drop: as :func:`handshake.receive_response`; then the genuine response can still come.
        """
        keys = handshake.receive_response(pending.initiated, response)
        del self.pending[response.receiver_index]
        return keys

    def receive_cookie(self, mac1: bytes, path: Path, reply: wire.CookieReply, now: float) -> None:
        """The peer is under load: keep its cookie, and try again soon.

        A cookie proves one address of ours. With several, such as one for IPv4 and one for IPv6, it is valid on that
        ``path`` alone. Raises ``BAD_COOKIE``.
        """
        cookie = self._mac_keys.open_cookie(reply, mac1)
        self._received_cookies.pop(path, None)
        while len(self._received_cookies) >= c.COOKIES_PER_PEER:
            del self._received_cookies[next(iter(self._received_cookies))]
        self._received_cookies[path] = cookie, now + c.COOKIE_HELD_S
        # Anyone who sees our datagrams can make a cookie, so it may not make us send faster than the first retry.
        soon = max(now, self.initiated_at + self.settings.link.timers.retry_min_s)
        self.retry_at = min(self.retry_at, soon)

    def add_macs(self, message: bytes, path: Path, now: float) -> bytes:
        """A handshake message to the peer with its macs, under the cookie for this path while there is one."""
        cookie, held_until = self._received_cookies.get(path, (None, now))
        return self._mac_keys.add_macs(message, cookie if now < held_until else None)

    def hurry(self, socket: int, now: float) -> None:
        """The network behind a socket has appeared or changed: try there at once, and often.

        Slow and metered networks behind other sockets keep their pace: this one may appear every second.
        """
        self._due_at.pop(socket, None)
        if socket in self._facts.metered:
            self._began_at = now
        self.attempts = min(self.attempts, 1)  # not 0: then the time of silence would restart for all of them
        self.retry_at = min(self.retry_at, now)

    def invite(self, now: float) -> None:
        """A relay shows that the peer is there: try soon, but not faster than the first retry. It may be a lie."""
        self.retry_at = min(self.retry_at, max(now, self.initiated_at + self.settings.link.timers.retry_min_s))

    def cancel(self) -> None:
        """Accept no response to what was sent so far."""
        for index in list(self.pending):
            self._forget(index)

    def expire(self, now: float) -> None:
        """Forget initiations that got no response."""
        for index in [index for index, pending in self.pending.items() if now >= pending.expires_at]:
            self._forget(index)

    @property
    def due_at(self) -> float:
        """When :meth:`expire` has something to do."""
        return min((pending.expires_at for pending in self.pending.values()), default=c.NEVER)

    def _forget(self, index: int) -> None:
        del self.pending[index]
        self._indices.owners.pop(index, None)
