"""What a daemon asks relays about other members, and when. uavlinkd/authority/README.md, "Introductions"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from uavlinkd.authority.constants import CERTIFICATES_PER_ANSWER, WHO_INTERVAL_S
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.relay_records import Who

WHO_AGAIN_S: Final = 0.1
"""Between two questions of a round, and between rounds while they find members: at least, and as long as an answer
takes."""

WHO_TRIES: Final = 2
"""A round ends after so many questions without an answer: one may be lost."""

WHO_ROUNDS: Final = 3
"""After so many that found no other member, the next one follows after `WHO_INTERVAL_S`."""


@dataclass(slots=True)
class _Asking:
    due_at: float
    rounds: int = 0
    """That ended since one found a member."""
    tries: int = 0
    """Of the last question; 0 while all rounds have ended."""
    after: int = 0
    """The highest serial of this round: ask on from there."""
    received: int = 0
    """Certificates since the last question."""


class MemberQuestions:
    """The questions to each relay that is up, by its static public key. Times are monotonic seconds.

    A round asks from serial 0 on until questions have no answer. There are more rounds, as parts of it may be lost.
    ``wait_s``: how long a relay's answer may take, at least.
    """

    def __init__(self, wait_s: Callable[[bytes], float] = lambda _: 0.0) -> None:
        self._wait_s = wait_s
        self._askings: dict[bytes, _Asking] = {}

    @property
    def next_at(self) -> float:
        """When :meth:`pop_due` has something."""
        return min((asking.due_at for asking in self._askings.values()), default=NEVER)

    def begin(self, relay: bytes, now: float) -> None:
        """A relay is up: ask it at once, and then regularly."""
        self._askings.setdefault(relay, _Asking(now))

    def end(self, relay: bytes) -> None:
        """It is not up any more, or is no relay."""
        self._askings.pop(relay, None)

    def pop_due(self, roles: int, now: float) -> Iterator[tuple[bytes, Who]]:
        """The questions to send now, each with its receiver. ``roles``: their bits."""
        for relay, asking in self._askings.items():
            if now >= asking.due_at:
                if asking.received:
                    asking.tries = 0
                elif asking.tries == WHO_TRIES:
                    asking.tries = asking.after = 0
                    asking.rounds += 1
                    if asking.rounds > WHO_ROUNDS:
                        asking.due_at = now + WHO_INTERVAL_S
                        continue
                yield relay, Who(roles, asking.after)
                asking.tries, asking.received = asking.tries + 1, 0
                asking.due_at = now + self._soon_s(relay)

    def note(self, relay: bytes, serial: int, now: float) -> None:
        """A relay sent the certificate with this serial. Ask for the others: at once if the answer was full.

        Without a question it is an introduction, which has no effect here.
        """
        asking = self._askings.get(relay)
        if asking is None or asking.tries == 0:
            return
        asking.received += 1
        asking.after = max(asking.after, serial)
        soon_s = 0.0 if asking.received == CERTIFICATES_PER_ANSWER else self._soon_s(relay)
        asking.due_at = min(asking.due_at, now + soon_s)

    def found(self, relay: bytes) -> None:
        """That certificate is accepted, and of a member that was not here."""
        if (asking := self._askings.get(relay)) is not None:
            asking.rounds = 0

    def _soon_s(self, relay: bytes) -> float:
        return max(self._wait_s(relay), WHO_AGAIN_S)
