"""The two drones of the demo, the counters of their frames, and the summary."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from uavlinkd.lab.sim.demo_attacks import AttackResult
from uavlinkd.lab.sim.drone_process import DroneProcess

LOST_AFTER_S = 2.0
"""A frame that has not arrived after this time is shown as lost. If it arrives later, it is delivered."""


@dataclass(slots=True)
class FrameCounts:
    """Counters for the frames of one autopilot to the other, compared byte for byte. ``now`` returns seconds."""

    now: Callable[[], float] = monotonic

    sent: int = 0
    delivered: int = 0
    arrived: int = 0
    """Delivered frames, including those outside the measured time."""
    altered: int = 0
    counting: bool = False
    _waiting: Counter[bytes] = field(default_factory=Counter)
    _uncounted: Counter[bytes] = field(default_factory=Counter)
    _recent: deque[tuple[float, bytes]] = field(default_factory=deque)
    _recent_copies: Counter[bytes] = field(default_factory=Counter)

    @property
    def outstanding(self) -> int:
        """Sent and not delivered."""
        return self.sent - self.delivered

    @property
    def in_flight(self) -> int:
        """Sent recently, and not yet delivered."""
        while self._recent and self.now() - self._recent[0][0] >= LOST_AFTER_S:
            _, frame = self._recent.popleft()
            self._recent_copies[frame] -= 1
            if not self._recent_copies[frame]:
                del self._recent_copies[frame]
        return sum(min(count, self._waiting[frame]) for frame, count in self._recent_copies.items())

    @property
    def lost(self) -> int:
        """Not delivered, and not in flight any more: the attacker or a daemon dropped the frame."""
        return self.outstanding - self.in_flight

    def on_sent(self, frame: bytes) -> None:
        """The autopilot sent a frame. Outside the measured time it is not counted."""
        if self.counting:
            self.sent += 1
            self._waiting[frame] += 1
            self._recent.append((self.now(), frame))
            self._recent_copies[frame] += 1
        else:
            self._uncounted[frame] += 1

    def on_received(self, frame: bytes) -> None:
        """The other autopilot received a frame."""
        if self._waiting[frame] > 0:
            self._waiting[frame] -= 1
            self.delivered += 1
            self.arrived += 1
        elif self._uncounted[frame] > 0:
            self._uncounted[frame] -= 1
            self.arrived += 1
        else:
            self.altered += 1


@dataclass(frozen=True, slots=True)
class Summary:
    """The result of the demo."""

    seconds: float
    frames_sent: int
    frames_delivered: int
    frames_altered: int
    handshakes: int
    drops: dict[str, int]
    rtt_ms: float | None
    attacks: list[AttackResult] | None = None
    """The attacks on the link; None for a demo without attacks."""
    is_recovered: bool = True
    """Whether frames were delivered in both directions after the last attack."""

    @property
    def is_perfect(self) -> bool:
        """Whether all frames, and at least one, arrived unaltered."""
        return self.frames_sent > 0 and self.frames_delivered == self.frames_sent and self.frames_altered == 0

    @property
    def is_good(self) -> bool:
        """Whether the demo is perfect; under attack, whether it delivered only genuine frames and the link recovered.

        Each attack must have attacked something. An attacker can always drop frames, so lost frames are allowed.
        """
        if self.attacks is None:
            return self.is_perfect
        is_real = all(attack.interventions > 0 for attack in self.attacks)
        return self.frames_delivered > 0 and self.frames_altered == 0 and is_real and self.is_recovered

    def to_json(self) -> str:
        """One line."""
        facts = asdict(self)
        if self.attacks is None:
            del facts["attacks"], facts["is_recovered"]
        return json.dumps(facts)


def refused_frames(status: Mapping[str, Any]) -> Counter[str]:
    """The frames that a daemon dropped, by reason: stale after a pause of the process, or refused by a policy."""
    counts: Counter[str] = Counter(stale=sum(status["stale"].values()))
    for sender in (*status["endpoints"].values(), *status["peers"].values()):
        for reasons in sender["refused"]["in"].values():
            counts.update({f"refused_{reason}": count for reason, count in reasons.items()})
    return +counts


class Drone(DroneProcess):
    """One of the two drones of the demo."""

    def __init__(self, name: str, folder: Path, port: int, endpoint_port: int) -> None:
        super().__init__(name, folder, port, endpoint_port)
        self._drops_before = Counter[str]()

    @property
    def drops(self) -> Counter[str]:
        """What the daemon dropped, by reason: datagrams, outgoing frames, and frames that it refused.

        Only drops since :meth:`begin` count.
        """
        return self._all_drops() - self._drops_before

    def begin(self) -> None:
        """Begin to count drops. Frames that the autopilot sent before the link was up had no session."""
        self._drops_before = self._all_drops()

    def _all_drops(self) -> Counter[str]:
        drops = Counter(self.status.get("drops", {}))
        drops.update(self.peer_status.get("drops", {}))
        if self.status:
            drops.update(self.status["send_failures"])
            drops.update(refused_frames(self.status))
        return drops

    @property
    def endpoint_url(self) -> str:
        """The URL for its autopilot."""
        return f"udpout:127.0.0.1:{self.endpoint_port}"

    @property
    def peer_status(self) -> dict[str, Any]:
        """The status of its only peer; empty before the first answer."""
        return next(iter(self.peer_statuses), {})
