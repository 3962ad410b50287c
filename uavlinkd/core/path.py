"""Whether a path leads to the peer: a question is sent along it, and answered from there."""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.constants import NEVER
from uavlinkd.core.crypto import Entropy, equal
from uavlinkd.core.outputs import Path
from uavlinkd.core.traffic import Traffic


@dataclass(frozen=True, slots=True)
class Challenge:
    """A question sent along a path of which nobody knows yet whether it leads to the peer."""

    token: bytes
    path: Path
    sent_at: float


class Challenger:
    """Asks along new paths, one at a time. What nobody answered is counted."""

    __slots__ = ("_asked_at", "_challenge", "_entropy", "_traffic")

    def __init__(self, entropy: Entropy, traffic: Traffic) -> None:
        self._entropy = entropy
        self._traffic = traffic
        self._challenge: Challenge | None = None
        self._asked_at = -NEVER  # answered or not: traffic must not be tossed about faster

    def question(self, path: Path, now: float) -> wire.PathChallenge | None:
        """What to send along a new path; None where something was asked a moment ago."""
        if now < self._asked_at + c.CHALLENGE_INTERVAL_S:
            return None
        self._asked_at = now
        self.expire(now)
        asked = self._challenge
        # The same question along the same path: the answer may take longer than the interval between two of them.
        if asked is None or asked.path != path:
            self.forget()
            asked = self._challenge = Challenge(self._entropy(c.PATH_TOKEN_BYTES), path, now)
        return wire.PathChallenge(asked.token)

    def take(self, token: bytes, path: Path, now: float) -> bool:
        """Whether this answers the question that waits; then none waits any more."""
        self.expire(now)
        asked = self._challenge
        if asked is None or path != asked.path or not equal(token, asked.token):
            return False
        self._challenge = None
        return True

    def forget(self) -> None:
        """No answer is wanted any more."""
        if self._challenge is not None:
            self._traffic.challenges_unanswered += 1
            self._challenge = None

    def expire(self, now: float) -> None:
        """Give up a question that waited too long."""
        if now >= self.next_expiry():
            self.forget()

    def next_expiry(self) -> float:
        """When :meth:`expire` has something to do."""
        return NEVER if self._challenge is None else self._challenge.sent_at + c.CHALLENGE_LIFETIME_S
