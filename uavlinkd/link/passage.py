"""Whether frames pass: per peer and endpoint, what was refused within the last seconds, and what was not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final, Literal, NamedTuple

from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal

WINDOW_S: Final = 10
"""How far back the samples reach, with one sample a second."""

Direction = Literal["in", "out"]
_DIRECTIONS: Final[tuple[Direction, ...]] = ("in", "out")


class Sample(NamedTuple):
    """Totals of one direction of a peer or endpoint."""

    frames: int
    """In: all received frames. Out: the sent frames, so without the refused ones."""
    refused: int


Key = tuple[str, str, Direction]
"""``peer`` or ``endpoint``, its name, and the direction."""


class Passage:
    """Keeps one sample a second of each direction of each peer and endpoint."""

    def __init__(self) -> None:
        self._samples: deque[dict[Key, Sample]] = deque(maxlen=WINDOW_S)

    def add_sample(self, links: Iterable[PeerLink], endpoints: Iterable[tuple[Endpoint, Policy]]) -> None:
        """Take a sample. Call it once a second."""
        self._samples.append({key: sample for key, _, sample in _totals(links, endpoints)})

    def blocked(self, links: Iterable[PeerLink], endpoints: Iterable[tuple[Endpoint, Policy]]) -> list[Key]:
        """The directions in which frames came within the last :data:`WINDOW_S`, and the policy refused all of them.

        A direction whose policy lets nothing pass (``allow_in = []``) is left out: that is intended.
        """
        before = self._samples[0] if self._samples else {}
        return [
            key
            for key, gate, sample in _totals(links, endpoints)
            if not gate.passes_nothing and _is_wholly_refused(key, before.get(key, Sample(0, 0)), sample)
        ]


def _is_wholly_refused(key: Key, before: Sample, after: Sample) -> bool:
    refused = _growth(before.refused, after.refused)
    frames = _growth(before.frames, after.frames)
    return refused > 0 and (frames <= refused if key[2] == "in" else frames == 0)


def _growth(before: int, after: int) -> int:
    return after - before if after >= before else after  # a reload with another policy starts its counts at zero


def _totals(
    links: Iterable[PeerLink], endpoints: Iterable[tuple[Endpoint, Policy]]
) -> Iterator[tuple[Key, Gate, Sample]]:
    for link in links:
        for direction in _DIRECTIONS:
            frames = link.counters.frames if direction == "in" else link.frames_sent
            gate = _gate(link.policy, direction)
            yield ("peer", link.name, direction), gate, Sample(frames, _refused(gate))
    for endpoint, policy in endpoints:
        for direction in _DIRECTIONS:
            frames = endpoint.counters.frames if direction == "in" else endpoint.frames_sent
            gate = _gate(policy, direction)
            yield ("endpoint", endpoint.name, direction), gate, Sample(frames, _refused(gate))


def _gate(policy: Policy, direction: Direction) -> Gate:
    return policy.incoming if direction == "in" else policy.outgoing


def _refused(gate: Gate) -> int:
    """Refused frames. A hidden frame is counted once for each client that reads it, so these are left out."""
    return sum(count for (_, refusal), count in gate.refused.items() if refusal is not Refusal.HIDDEN_FRAME)
