"""The echo requests to one peer that can be answered in time."""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.core import constants as c
from uavlinkd.core.path_loss import NO_REPEATS, Repeats
from uavlinkd.core.session import Session


@dataclass(slots=True)
class EchoRequest:
    """An echo request that was sent."""

    session: Session | None
    """On which it was sent; None if that has ended."""
    sent_at: float
    sent: int
    """Envelopes of the session until then, the request included, without questions to candidates."""
    repeats: Repeats
    """Of them, along the best path."""
    is_answered: bool = False


class EchoRequests:
    """The echo requests to one peer, on all its sessions.

    A request older than :data:`c.LATE_AFTER_S` is forgotten: an answer to it is late, however many were sent since.
    """

    __slots__ = ("_by_token", "_last")

    def __init__(self) -> None:
        self._last = 0
        self._by_token: dict[int, EchoRequest] = {}  # the oldest first

    def __len__(self) -> int:
        return len(self._by_token)

    def add(self, session: Session, now: float, sent: int = 0, repeats: Repeats = NO_REPEATS) -> int:
        """The token of a new request."""
        self._last += 1
        token = self._last % 2**32
        self._by_token[token] = EchoRequest(session, now, sent, repeats)
        return token

    def expire(self, now: float) -> int:
        """Forget the requests that can only be answered late. Returns how many of them were not answered."""
        expired = [token for token, request in self._by_token.items() if request.sent_at < now - c.LATE_AFTER_S]
        return sum(not self._by_token.pop(token).is_answered for token in expired)

    def find(self, token: int) -> EchoRequest | None:
        """The request with this token; None if it is forgotten, or never was sent."""
        return self._by_token.get(token)

    def forget(self, session: Session) -> None:
        """A session has ended: an answer to a request on it measures the round trip only."""
        for request in self._by_token.values():
            if request.session is session:
                request.session = None

    def was_sent(self, token: int) -> bool:
        """Whether there ever was such a request."""
        return 0 < token <= self._last
