"""The frames that wait for one slow link, or of one source for one slow client: three bounded lanes of flows.

Urgent frames are next. The rest of the link's capacity is divided equally, by bytes, between events and states, while
both wait. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Final

from uavlinkd.mavlink.classes import Lane
from uavlinkd.mavlink.egress.queue import Flow, Queue, Waiting
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame

FLOWS_PER_LANE: Final = 2
"""One flow gets at most this part of its lane. A flow that floods a lane drops its own frames, not another's."""


class EgressDrop(StrEnum):
    """Why a frame was not sent."""

    STALE = "stale"  # waited longer than max_age_s
    THINNED = "thinned"  # a newer frame of the same state arrived
    OVERFLOW = "overflow"  # the oldest of too many
    CLOSED = "closed"  # the peer is lost


IsSuperseded = Callable[[Waiting, Frame, float], bool]
"""Whether a newer frame of the same state replaces the one that waits: (waiting, newer, now)."""
OnDrop = Callable[[Waiting, EgressDrop], None]


class Lanes:
    """Frames that wait, by lane and flow. Within a flow the order is never reversed."""

    __slots__ = (
        "_flow_bytes",
        "_flows",
        "_flows_limit",
        "_is_superseded",
        "_lane_bytes",
        "_lead",
        "_max_flows",
        "_number",
        "_on_drop",
        "queues",
    )

    def __init__(self, lane_bytes: float, max_flows: int, is_superseded: IsSuperseded, on_drop: OnDrop) -> None:
        self.queues = (Queue(), Queue(), Queue())
        """By lane."""
        self._lane_bytes = lane_bytes
        self._flow_bytes = lane_bytes / FLOWS_PER_LANE
        self._max_flows = max_flows
        self._is_superseded = is_superseded
        self._on_drop = on_drop
        self._flows: dict[FlowKey, Flow] = {}
        self._flows_limit = max_flows
        self._number = 0
        self._lead = 0  # bytes of events sent beyond those of states, while both wait

    @property
    def count(self) -> int:
        """How many frames wait."""
        urgent, events, states = self.queues
        return urgent.count + events.count + states.count

    @property
    def size(self) -> int:
        """How many bytes of frames wait."""
        urgent, events, states = self.queues
        return urgent.size + events.size + states.size

    def put(self, frame: Frame, now: float) -> Lane:
        """Let a frame wait. A state replaces older ones that are superseded. The oldest of too many is dropped.

        Returns:
            The frame's lane.
        """
        flow = self._flow_of(frame, now)
        queue = self.queues[flow.lane]
        if not flow.frames:
            flow.since = now
        elif flow.is_state:
            while flow.frames and self._is_superseded(flow.frames[0], frame, now):
                self.drop(flow.frames[0], EgressDrop.THINNED)
        self._number += 1
        queue.add(Waiting(frame, flow, now, self._number))
        if flow.size > self._flow_bytes:
            self.drop(flow.frames[0], EgressDrop.OVERFLOW)
        elif queue.size > self._lane_bytes:
            oldest = queue.oldest()
            assert oldest is not None
            self.drop(oldest, EgressDrop.OVERFLOW)
        return flow.lane

    def first(self) -> Waiting | None:
        """The oldest frame: there is room for all."""
        heads = [oldest for queue in self.queues if (oldest := queue.oldest())]
        return min(heads, key=by_number) if heads else None

    def next(self) -> Waiting | None:
        """The most important frame."""
        return self.next_urgent() or self.next_of_the_rest()

    def next_urgent(self) -> Waiting | None:
        """The urgent frame whose turn it is."""
        urgent = self.queues[Lane.URGENT]
        return urgent.head() if urgent.count else None

    def next_of_the_rest(self) -> Waiting | None:
        """The event or state whose turn it is."""
        _, events, states = self.queues
        if events.count and not (states.count and self._lead > 0):
            return events.head()
        return states.head() if states.count else None

    def serve(self, waiting: Waiting, now: float) -> None:
        """Take out a frame to be sent: the first of its flow."""
        _, events, states = self.queues
        lane = waiting.flow.lane
        if lane is not Lane.URGENT:
            size = len(waiting.frame.raw) if lane is Lane.EVENTS else -len(waiting.frame.raw)
            self._lead = self._lead + size if events.count and states.count else 0
        self.queues[lane].serve(waiting, now)

    def drop_stale(self, now: float, max_age_s: float) -> None:
        """Drop the frames that have waited longer than ``max_age_s``."""
        for queue in self.queues:
            while (oldest := queue.oldest()) is not None and now - oldest.put_at > max_age_s:
                self.drop(oldest, EgressDrop.STALE)

    def drop_from_largest(self) -> None:
        """Drop the oldest frame of the lane that holds most bytes. There must be one."""
        oldest = max(self.queues, key=_size_of).oldest()
        assert oldest is not None
        self.drop(oldest, EgressDrop.OVERFLOW)

    def pop_all(self) -> list[Waiting]:
        """Take out all frames that wait, in the order of arrival."""
        popped: list[Waiting] = []
        while (first := self.first()) is not None:
            self.queues[first.flow.lane].remove(first)
            popped.append(first)
        return popped

    def clear(self) -> None:
        """Drop all frames that wait: the link is lost."""
        for queue in self.queues:
            while (oldest := queue.oldest()) is not None:
                self.drop(oldest, EgressDrop.CLOSED)

    def drop(self, waiting: Waiting, reason: EgressDrop) -> None:
        """Take out the first frame of a flow and report it as dropped."""
        self.queues[waiting.flow.lane].remove(waiting)
        self._on_drop(waiting, reason)

    def _flow_of(self, frame: Frame, now: float) -> Flow:
        key = flow_key(frame)
        flow = self._flows.get(key)
        if flow is None:
            if len(self._flows) >= self._flows_limit:
                self._flows = {key: flow for key, flow in self._flows.items() if flow.frames}
                self._flows_limit = max(self._max_flows, 2 * len(self._flows))
            flow = self._flows[key] = Flow(frame.header.kind, now)
        return flow


def by_number(waiting: Waiting) -> int:
    """For sorting in the order of arrival."""
    return waiting.number


def _size_of(queue: Queue) -> int:
    return queue.size
