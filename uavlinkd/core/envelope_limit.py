"""The longest envelope that a path carries, found by padded probes. README.md, section 15.

A path may drop long datagrams and report nothing. Short probes are answered there, and frames are lost.
"""

from __future__ import annotations

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER


def limit_at(budget_bits_s: float, carrier_bytes: int = c.LINE_BYTES) -> int:
    """The longest envelope, in bytes, that several frames share on a slow network with this budget.

    So much as it carries in :data:`c.ENVELOPE_AIR_S`: a command waits no longer for the envelope before it.
    ``carrier_bytes``: what the network adds to a datagram; by default the framing of a serial line.
    """
    size = int(budget_bits_s * c.ENVELOPE_AIR_S / 8) - carrier_bytes
    return min(max(size, c.SLOW_ENVELOPE_LEAST), c.SLOW_ENVELOPE_MOST)


class EnvelopeLimit:
    """The limit of one path: that of the session until tests of this length were not answered."""

    __slots__ = ("_asked", "_asked_at", "_tries", "limit", "next_at")

    def __init__(self) -> None:
        self.limit = c.MAX_ENVELOPE_LIMIT
        """Bytes. Longer envelopes are not sent along the path."""
        self.next_at = NEVER
        """When the next test is due; infinity without one."""
        self._asked = 0  # the question of the last test; 0 without one
        self._asked_at = NEVER
        self._tries = 0

    def begin(self, now: float) -> None:
        """The path was proved, or may have changed: test it."""
        self.limit, self._asked, self._tries = c.MAX_ENVELOPE_LIMIT, 0, 0
        self.next_at = now

    def size_to_test(self, longest: int, answered_at: float, now: float) -> int:
        """The length of the envelope to be sent as a test now; 0 for none.

        ``longest``: of the session, or of the network if that is less. ``answered_at``: when a short
        question was answered last.
        """
        if now < self.next_at:
            return 0
        if self._asked and answered_at > self._asked_at:  # the path works, and the test got no answer
            self._tries += 1
            if self._tries >= c.LIMIT_TESTS:
                shorter = (size for size in c.SMALLER_LIMITS if size < min(self.limit, longest))
                self.limit, self._tries = next(shorter, c.SMALLER_LIMITS[-1]), 0
        size = min(self.limit, longest)
        self.next_at = NEVER if size <= c.SMALLER_LIMITS[-1] else now + c.LIMIT_TEST_S
        return 0 if self.next_at == NEVER else size

    def asked(self, question: int, now: float) -> None:
        """The test was sent with this question."""
        self._asked, self._asked_at = question, now

    def receive_answer(self, answer: int) -> None:
        """A question was answered. If it was the test, the path carries the limit."""
        if answer == self._asked:
            self._asked, self.next_at = 0, NEVER
