"""Admission: which handshake messages may cost work, before anything in them is authentic or while replays are.

Every limit that strangers can use up has a share beside it that they cannot: for a sender that proves its address by
a cookie, and above all for one at an address where a peer is known to be. README.md, sections 7 and 13.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, NoReturn, Protocol

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.limits import GroupBudget, SourceLimiter, TokenBucket, prefix_of, source_of
from uavlinkd.protocol.outputs import Transmit
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.suites import Suite


class CookieRequired(Drop):
    """A message is refused, and its sender gets a cookie to try again with."""

    def __init__(self, reply: Transmit) -> None:
        super().__init__(DropReason.COOKIE_REQUIRED)
        self.reply = reply


class Cookies(Protocol):
    """The cookies of one static key of this daemon, in one protocol."""

    def has_valid_mac2(self, datagram: bytes, path: Path, now: float) -> bool:
        """Whether the message proves its address by a cookie."""

    def reply(self, datagram: bytes, sender_index: int, path: Path, now: float) -> bytes:
        """A cookie for the sender of the message."""


class Message(NamedTuple):
    """A handshake message that asks for work, and the cookies of the key that it is for."""

    datagram: bytes
    sender_index: int
    path: Path
    cookies: Cookies

    def has_cookie(self, now: float) -> bool:
        """Whether it proves its address."""
        return self.cookies.has_valid_mac2(self.datagram, self.path, now)


class Admission:
    """The budgets for handshake messages of one daemon. Each method returns if the message may cost that work.

    ``is_known`` says whether a peer is configured or was last seen at an address. ``most_admitted``: peers that may
    come by certificate.
    """

    def __init__(self, is_known: Callable[[SocketAddress], bool], now: float, most_admitted: int = 0) -> None:
        self._is_known = is_known
        self._most_admitted = most_admitted
        # Two budgets: a flood of initiations must not keep our own handshakes from finishing.
        self._initiations = TokenBucket(*c.INITIATIONS, now)
        self._responses = TokenBucket(*c.INITIATIONS, now)
        self._cookied = TokenBucket(c.COOKIED_PER_S, c.COOKIED_PER_S, now)
        self._sources = SourceLimiter(*c.COOKIED_PER_SOURCE)
        self._read = TokenBucket(*c.INITIATIONS_READ, now)
        self._known_read = SourceLimiter(*c.INITIATIONS_READ_PER_KNOWN)
        self._versions = TokenBucket(*c.VERSION_CHECKS, now)
        self._known_versions = SourceLimiter(*c.VERSION_CHECKS_PER_KNOWN)
        self._cookie_replies = TokenBucket(c.COOKIE_REPLIES_PER_S, c.COOKIE_REPLIES_PER_S, now)
        self._prefixes = SourceLimiter(*c.COOKIE_REPLIES_PER_PREFIX)
        self._known = SourceLimiter(*c.COOKIE_REPLIES_PER_KNOWN)
        self._group = GroupBudget(now)
        self.set_peers(0)

    def set_peers(self, count: int) -> None:
        """So many peers may initiate at once, when this daemon starts again. The rate afterwards stays as it is.

        Those by certificate are not known then.
        """
        burst = min(c.INITIATIONS_BURST_PER_PEER * max(count, self._most_admitted), c.INITIATIONS_BURST_MOST)
        self._initiations.set_burst(max(c.INITIATIONS.burst, burst))

    def read(self, path: Path, now: float) -> None:
        """An initiation from there is to be read. Raises ``RATE_LIMITED``."""
        if not self._take(self._known_read, self._read, path, now):
            raise Drop(DropReason.RATE_LIMITED)

    def may_compare_versions(self, path: Path, now: float) -> bool:
        """Whether an initiation from there that is not for us may be compared with other versions."""
        return self._take(self._known_versions, self._versions, path, now)

    def admit(self, message: Message, now: float, *, is_response: bool) -> None:
        """An initiation or a response costs a key exchange. Raises ``COOKIE_REQUIRED`` or ``RATE_LIMITED``."""
        self._admit(self._responses if is_response else self._initiations, self._cookied, message, now)

    def admit_answer(self, peer: Peer, message: Message, now: float) -> None:
        """An authentic initiation of this peer is to be answered. Raises ``COOKIE_REQUIRED`` or ``RATE_LIMITED``."""
        # Recorded initiations of this peer can be replayed from anywhere: they may use up the answers to all senders,
        # not those to a sender that proves its address.
        self._admit(peer.answers, peer.cookied_answers, message, now)

    def admit_group(self, peer: Peer, suite: Suite, message: Message, now: float) -> None:
        """An authentic initiation costs the arithmetic of its group.

        Raises ``GROUP_BUDGET_SPENT``; ``COOKIE_REQUIRED`` or ``RATE_LIMITED`` where a cookie would help.
        """
        # An attacker can send a recorded initiation under the peer's own address: only a cookie proves an address.
        is_there = peer.paths.find(message.path) is not None
        is_proven = is_there and message.has_cookie(now)
        if is_proven and peer.proven_group_work.take(now, suite.work):
            return
        if self._group.take(peer.group_work, source_of(message.path.host), suite.work, now):
            return
        if is_there and not is_proven:
            self._require_cookie(message, now)
        raise Drop(DropReason.GROUP_BUDGET_SPENT)

    def _take(self, known: SourceLimiter, budget: TokenBucket, path: Path, now: float) -> bool:
        """Where a peer is known to be, a flood from elsewhere does not count."""
        return (self._is_known(path.place) and known.take(path.sender, now)) or budget.take(now)

    def _admit(self, budget: TokenBucket, ceiling: TokenBucket, message: Message, now: float) -> None:
        """Until the budget is spent, each message; then those with a cookie, by their source's share."""
        if budget.take(now):
            return
        if not message.has_cookie(now):
            self._require_cookie(message, now)
        # A sender with a cookie for a known address has its own rate limit: it does not queue with others of its host
        # or network, such as those behind one router, nor with the owner of many addresses, which the ceiling limits.
        path = message.path
        is_known = self._is_known(path.place)
        if not self._sources.take((ceiling, path.sender if is_known else source_of(path.host)), now):
            raise Drop(DropReason.RATE_LIMITED)
        if not is_known and not ceiling.take(now):
            raise Drop(DropReason.RATE_LIMITED)

    def _require_cookie(self, message: Message, now: float) -> NoReturn:
        """Refuse a message without a cookie, and send one back unless too many were sent there.

        Raises ``COOKIE_REQUIRED``, or ``RATE_LIMITED`` without a reply.
        """
        datagram, sender_index, path, cookies = message
        is_due = self._is_known(path.place) and self._known.take(path.sender, now)
        # The total is looked at first: a flood from many prefixes then costs no more than this.
        if not is_due and self._cookie_replies.has(now):
            is_due = self._prefixes.take(prefix_of(path.host), now) and self._cookie_replies.take(now)
        if not is_due:
            raise Drop(DropReason.RATE_LIMITED)
        raise CookieRequired(Transmit(cookies.reply(datagram, sender_index, path, now), path))
