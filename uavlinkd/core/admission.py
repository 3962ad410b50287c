"""Admission: which handshake messages may cost work, before anything in them is authentic or while replays are.

Every limit that strangers can use up has a share beside it that they cannot: a sender that proves its address by a
cookie, and most of all one at an address where a peer is known to be. README.md, sections 7 and 13.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, NoReturn

from uavlinkd.core import constants as c
from uavlinkd.core.cookie import CookieJar
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.group_budget import GroupBudget
from uavlinkd.core.limits import SourceLimiter, TokenBucket, prefix_of, source_of
from uavlinkd.core.outputs import Output, Path, Transmit
from uavlinkd.core.peer import Peer
from uavlinkd.core.suites import Suite


class Message(NamedTuple):
    """A handshake message that asks for work, and the cookies of the key that it is for."""

    datagram: bytes
    sender_index: int
    path: Path
    cookies: CookieJar

    def has_cookie(self, now: float) -> bool:
        """Whether it proves its address."""
        return self.cookies.has_valid_mac2(self.datagram, self.path, now)


class Admission:
    """The budgets for handshake messages of one daemon. Methods that admit append cookie replies to ``out``.

    ``is_known`` says whether a peer is configured or was last seen at a host and port.
    """

    def __init__(self, is_known: Callable[[tuple[str, int]], bool], now: float) -> None:
        self._is_known = is_known
        # Two budgets: a flood of initiations must not keep our own handshakes from finishing.
        self._initiations = TokenBucket(c.INITIATIONS_PER_S, c.INITIATIONS_BURST, now)
        self._responses = TokenBucket(c.INITIATIONS_PER_S, c.INITIATIONS_BURST, now)
        self._cookied = TokenBucket(c.COOKIED_PER_S, c.COOKIED_PER_S, now)
        self._sources = SourceLimiter(c.COOKIED_PER_SOURCE_PER_S, c.COOKIED_PER_SOURCE_BURST, c.SOURCES_TRACKED)
        self._read = TokenBucket(c.INITIATIONS_READ_PER_S, c.INITIATIONS_READ_BURST, now)
        self._known_read = SourceLimiter(
            c.INITIATIONS_READ_PER_KNOWN_PER_S, c.INITIATIONS_READ_PER_KNOWN_BURST, c.SOURCES_TRACKED
        )
        self._cookie_replies = TokenBucket(c.COOKIE_REPLIES_PER_S, c.COOKIE_REPLIES_PER_S, now)
        self._prefixes = SourceLimiter(
            c.COOKIE_REPLIES_PER_PREFIX_PER_S, c.COOKIE_REPLIES_PER_PREFIX_BURST, c.SOURCES_TRACKED
        )
        self._known = SourceLimiter(
            c.COOKIE_REPLIES_PER_KNOWN_PER_S, c.COOKIE_REPLIES_PER_KNOWN_BURST, c.SOURCES_TRACKED
        )
        self._group = GroupBudget(now)

    def read(self, path: Path, now: float) -> None:
        """Whether an initiation from there may be read at all.

        Raises:
            Drop: ``RATE_LIMITED``.
        """
        address = path[1:]
        # Where a peer is known to be, a flood from elsewhere does not count.
        if not (self._is_known(address) and self._known_read.take(address, now)) and not self._read.take(now):
            raise Drop(DropReason.RATE_LIMITED)

    def admit_initiation(self, message: Message, now: float, out: list[Output]) -> None:
        """Whether an initiation may cost its key exchange.

        Raises:
            Drop: ``COOKIE_REQUIRED`` or ``RATE_LIMITED``.
        """
        self._admit(self._initiations, self._cookied, message, now, out)

    def admit_response(self, message: Message, now: float, out: list[Output]) -> None:
        """Whether a response may cost its key exchange.

        Raises:
            Drop: ``COOKIE_REQUIRED`` or ``RATE_LIMITED``.
        """
        self._admit(self._responses, self._cookied, message, now, out)

    def admit_answer(self, peer: Peer, message: Message, now: float, out: list[Output]) -> None:
        """Whether an authentic initiation of this peer may be answered.

        Raises:
            Drop: ``COOKIE_REQUIRED`` or ``RATE_LIMITED``.
        """
        # Recorded initiations of this peer can be replayed from anywhere: they may use up the answers to everybody,
        # not those to the one who proves its address.
        answers = peer.answers_while_up if peer.is_up else peer.answers
        self._admit(answers, peer.cookied_answers, message, now, out)

    def admit_group(self, peer: Peer, suite: Suite, message: Message, now: float, out: list[Output]) -> None:
        """Whether an authentic initiation may cost the arithmetic of its group.

        Raises:
            Drop: ``GROUP_BUDGET_SPENT``; ``COOKIE_REQUIRED`` or ``RATE_LIMITED`` where a cookie would help.
        """
        # An attacker can send a recorded initiation under the peer's own address: only a cookie proves an address.
        is_there = message.path in peer.caller.candidates(peer.path)
        is_proven = is_there and message.has_cookie(now)
        if is_proven and peer.group_share.proven.take(now, suite.work):
            return
        if self._group.take(peer.group_share, source_of(message.path[1]), suite.work, now):
            return
        if is_there and not is_proven:
            self._require_cookie(message, now, out)
        raise Drop(DropReason.GROUP_BUDGET_SPENT)

    def _admit(
        self, budget: TokenBucket, ceiling: TokenBucket, message: Message, now: float, out: list[Output]
    ) -> None:
        """Until the budget is spent, each message; then those with a cookie, by their source's share."""
        if budget.take(now):
            return
        if not message.has_cookie(now):
            self._require_cookie(message, now, out)
        # Who proved an address of a peer does not queue with strangers: neither with those of its host or network,
        # such as others behind one router, nor with those of many addresses, for whom the ceiling is.
        _, host, port = message.path
        is_known = self._is_known((host, port))
        if not self._sources.take((ceiling, (host, port) if is_known else source_of(host)), now):
            raise Drop(DropReason.RATE_LIMITED)
        if not is_known and not ceiling.take(now):
            raise Drop(DropReason.RATE_LIMITED)

    def _require_cookie(self, message: Message, now: float, out: list[Output]) -> NoReturn:
        """Refuse a message without a cookie, and send one back unless too many were sent there.

        Raises:
            Drop: ``COOKIE_REQUIRED``, or ``RATE_LIMITED`` without a reply.
        """
        datagram, sender_index, path, cookies = message
        _, host, port = path
        is_due = self._is_known((host, port)) and self._known.take((host, port), now)
        # The total is looked at first: a flood from many prefixes then costs no more than this.
        if not is_due and self._cookie_replies.has(now):
            is_due = self._prefixes.take(prefix_of(host), now) and self._cookie_replies.take(now)
        if not is_due:
            raise Drop(DropReason.RATE_LIMITED)
        out.append(Transmit(cookies.reply(datagram, sender_index, path, now), path))
        raise Drop(DropReason.COOKIE_REQUIRED)
