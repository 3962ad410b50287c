"""Path challenges: whether a new path leads to the peer."""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.constants import NEVER
from uavlinkd.core.crypto import Entropy, equal
from uavlinkd.core.path import Path
from uavlinkd.core.traffic import Traffic


@dataclass(frozen=True, slots=True)
class Challenge:
    """A challenge that was sent along a path and may still be answered."""

    token: bytes
    path: Path
    sent_at: float


class Challenger:
    """Challenges new paths, one at a time, and counts the challenges that nothing answered.

    A challenge stays valid while keys change: an honest peer may change its address and its keys at the same time.
    """

    __slots__ = ("_challenge", "_entropy", "_is_proven", "_sent_at", "_traffic")

    def __init__(self, entropy: Entropy, traffic: Traffic) -> None:
        self._entropy = entropy
        self._traffic = traffic
        self._challenge: Challenge | None = None
        self._is_proven = False
        self._sent_at = -NEVER  # answered or not: traffic must not change its path more often

    def challenge(self, path: Path, now: float) -> wire.PathChallenge | None:
        """What to send along a new path; None if a challenge was sent a moment ago."""
        if now < self._sent_at + c.CHALLENGE_INTERVAL_S:
            return None
        self._sent_at = now
        self.expire(now)
        challenge = self._challenge
        # The same token along the same path: the answer may take longer than the interval between two challenges.
        if challenge is None or challenge.path != path:
            self._forget()
            challenge = self._challenge = Challenge(self._entropy(c.PATH_TOKEN_BYTES), path, now)
        return wire.PathChallenge(challenge.token)

    def receive_response(self, token: bytes, path: Path, now: float) -> bool:
        """Whether this answers the challenge that waits. If so, it waits no more."""
        self.expire(now)
        challenge = self._challenge
        if challenge is None or path != challenge.path or not equal(token, challenge.token):
            return False
        self._challenge, self._is_proven = None, False
        return True

    def note_handshake(self, path: Path) -> None:
        """A handshake along this path proved what a challenge along it asks. A response may still come."""
        if self._challenge is not None and self._challenge.path == path:
            self._is_proven = True

    def expire(self, now: float) -> None:
        """Give up a challenge that has waited for too long."""
        if now >= self.next_expiry():
            self._forget()

    def next_expiry(self) -> float:
        """When :meth:`expire` has something to do."""
        return NEVER if self._challenge is None else self._challenge.sent_at + c.CHALLENGE_LIFETIME_S

    def _forget(self) -> None:
        if self._challenge is not None and not self._is_proven:
            self._traffic.challenges_unanswered += 1
        self._challenge, self._is_proven = None, False
