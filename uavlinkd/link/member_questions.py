"""What a daemon asks relays about other members, and when. uavlinkd/authority/README.md, "Introductions"."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from uavlinkd.authority.constants import CERTIFICATES_PER_ANSWER, WHO_INTERVAL_S
from uavlinkd.core.constants import NEVER
from uavlinkd.core.relay_records import Who

WHO_SOON_S: Final = 0.5
"""A question without an answer is repeated after this, and each time after twice as long."""


@dataclass(slots=True)
class _Asking:
    due_at: float
    tries: int = 0
    after: int = 0
    """The highest serial of an answer, if it was full: ask on from there."""
    received: int = 0
    """Certificates since the last question."""


class MemberQuestions:
    """The questions to each relay that is up, by its static public key. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._askings: dict[bytes, _Asking] = {}

    @property
    def next_at(self) -> float:
        """When :meth:`pop_due` has something."""
        return min((asking.due_at for asking in self._askings.values()), default=NEVER)

    def begin(self, relay: bytes, now: float) -> None:
        """A relay is up: ask it at once, and then regularly."""
        self._askings[relay] = _Asking(now)

    def end(self, relay: bytes) -> None:
        """It is not up any more, or is no relay."""
        self._askings.pop(relay, None)

    def pop_due(self, roles: int, now: float) -> Iterator[tuple[bytes, Who]]:
        """The questions to send now, each with its receiver. ``roles``: their bits."""
        for relay, asking in self._askings.items():
            if now >= asking.due_at:
                yield relay, Who(roles, asking.after)
                asking.due_at = now + min(WHO_INTERVAL_S, WHO_SOON_S * 2.0 ** min(asking.tries, 8))
                asking.tries += 1
                asking.received = asking.after = 0

    def note(self, relay: bytes, serial: int, now: float) -> None:
        """A relay sent the certificate with this serial. After a full answer it is asked for the others at once."""
        if (asking := self._askings.get(relay)) is not None:
            asking.received += 1
            asking.after = max(asking.after, serial)
            is_full = asking.received == CERTIFICATES_PER_ANSWER
            asking.due_at = now if is_full else now + WHO_INTERVAL_S
