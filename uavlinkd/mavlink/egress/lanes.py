"""The frames that wait for one slow link, or of one source for one slow client: three bounded lanes of flows.

Urgent frames are next. The rest of the link's capacity is divided equally, by bytes, between events and states, while
both wait. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from operator import attrgetter
from typing import Final

from uavlinkd.mavlink.dialect import Lane, MessageKind
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.drops import Reason

FLOWS_PER_LANE: Final = 2
"""One flow gets at most this part of its lane. A flow that floods a lane drops its own frames, not another's."""


class EgressDrop(Reason):
    """Why a frame was not sent."""

    STALE = "stale", "it waited longer than max_age_s", "waited too long"
    THINNED = "thinned", "a newer frame of the same state arrived", "replaced by newer ones"
    OVERFLOW = "overflow", "it was the oldest of too many", "above the queue's limit"
    CLOSED = "closed", "the peer is lost", "waiting when the link ended"


@dataclass(slots=True, eq=False)
class Waiting:
    """One frame that waits."""

    frame: Frame
    flow: Flow
    put_at: float
    number: int  # in the order of arrival
    is_waiting: bool = True


class Flow:
    """Frames that follow or replace one another, the oldest first."""

    __slots__ = ("frames", "is_in_line", "is_state", "lane", "sent_at", "since", "size")

    def __init__(self, kind: MessageKind, now: float) -> None:
        self.lane = kind.lane
        self.is_state = kind.is_state
        self.frames: deque[Waiting] = deque()
        self.size = 0  # bytes of these
        # A new flow counts as just sent. Otherwise new flows, which a sender can invent, would always go first.
        self.sent_at = now
        self.since = now  # when it began to have frames; a newer state that replaces an older one changes nothing
        self.is_in_line = False  # of its lane

    @property
    def rank(self) -> float:
        """The lowest is next: of urgent flows the longest waiting one, of others the one not sent for longest."""
        return max(self.since, self.sent_at) if self.lane is Lane.URGENT else self.sent_at


class Queue:
    """One lane: its frames by arrival, and its flows by whose turn is next."""

    __slots__ = ("arrivals", "count", "line", "size")

    def __init__(self) -> None:
        self.arrivals: deque[Waiting] = deque()  # with some that no longer wait
        self.line: list[tuple[float, int, Flow]] = []  # a heap, with some flows without frames
        self.count = 0
        self.size = 0  # bytes that wait

    def add(self, frame: Waiting) -> None:
        flow = frame.flow
        flow.frames.append(frame)
        self.arrivals.append(frame)
        self.count += 1
        flow.size += len(frame.frame.raw)
        self.size += len(frame.frame.raw)
        if len(self.arrivals) > 2 * self.count + 64:
            self.arrivals = deque(frame for frame in self.arrivals if frame.is_waiting)
        if not flow.is_in_line:
            self._join_line(flow)

    def _join_line(self, flow: Flow) -> None:
        if len(self.line) > 2 * self.count + 64:
            for *_, other in self.line:
                other.is_in_line = bool(other.frames)
            self.line = [place for place in self.line if place[2].is_in_line]
            heapify(self.line)
        heappush(self.line, (flow.rank, flow.frames[0].number, flow))
        flow.is_in_line = True

    def head(self) -> Waiting:
        """The frame whose turn it is. There must be one."""
        while True:
            rank, _, flow = self.line[0]
            if flow.frames and flow.rank <= rank:
                return flow.frames[0]
            heappop(self.line)
            flow.is_in_line = False
            if flow.frames:  # sent since, out of turn
                self._join_line(flow)

    def oldest(self) -> Waiting | None:
        """The frame that has waited longest: always the first of its flow."""
        arrivals = self.arrivals
        while arrivals and not arrivals[0].is_waiting:
            arrivals.popleft()
        return arrivals[0] if arrivals else None

    def remove(self, frame: Waiting) -> None:
        frame.flow.frames.popleft()
        frame.flow.size -= len(frame.frame.raw)
        frame.is_waiting = False
        self.count -= 1
        self.size -= len(frame.frame.raw)


IsSuperseded = Callable[[Waiting, Frame, float], bool]
"""Whether a newer frame of the same state replaces the one that waits: (waiting, newer, now)."""
by_number: Final = attrgetter("number")  # for sorting in the order of arrival


def is_urgent(frame: Frame) -> bool:
    """Whether a frame goes before others on a slow link."""
    return frame.header.kind.lane is Lane.URGENT


OnDrop = Callable[[Waiting, EgressDrop], None]


class Lanes:
    """Frames that wait, by lane and flow. Within a flow the order is never reversed."""

    def __init__(self, lane_bytes: float, max_flows: int, is_superseded: IsSuperseded, on_drop: OnDrop) -> None:
        self.queues = (Queue(), Queue(), Queue())  # by lane
        self.lane_bytes = lane_bytes
        self._max_flows = max_flows
        self._is_superseded = is_superseded
        self._on_drop = on_drop
        self._flows: dict[FlowKey, Flow] = {}
        self._flows_limit = max_flows
        self._number = 0
        self._lead = 0  # bytes of events sent beyond those of states, while both wait

    @property
    def count(self) -> int:
        urgent, events, states = self.queues
        return urgent.count + events.count + states.count

    @property
    def size(self) -> int:
        urgent, events, states = self.queues
        return urgent.size + events.size + states.size

    def put(self, frame: Frame, now: float) -> Lane:
        """Let a frame wait in the lane that is returned. Superseded states and the oldest of too many go."""
        flow = self._flow_of(frame, now)
        queue = self.queues[flow.lane]
        if not flow.frames:
            flow.since = now
        elif flow.is_state:
            while flow.frames and self._is_superseded(flow.frames[0], frame, now):
                self.drop(flow.frames[0], EgressDrop.THINNED)
        self._number += 1
        queue.add(Waiting(frame, flow, now, self._number))
        if flow.size > self.lane_bytes / FLOWS_PER_LANE:
            self.drop(flow.frames[0], EgressDrop.OVERFLOW)
        elif queue.size > self.lane_bytes:
            oldest = queue.oldest()
            assert oldest is not None
            self.drop(oldest, EgressDrop.OVERFLOW)
        return flow.lane

    def next(self) -> Waiting | None:
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
        flow = waiting.flow
        if flow.lane is not Lane.URGENT:
            size = len(waiting.frame.raw) if flow.lane is Lane.EVENTS else -len(waiting.frame.raw)
            self._lead = self._lead + size if events.count and states.count else 0
        self.queues[flow.lane].remove(waiting)
        flow.sent_at = now
        if flow.frames:
            flow.since = flow.frames[0].put_at

    def drop_stale(self, now: float, max_age_s: float) -> None:
        for queue in self.queues:
            while (oldest := queue.oldest()) is not None and now - oldest.put_at > max_age_s:
                self.drop(oldest, EgressDrop.STALE)

    def drop_from_largest(self) -> None:
        """Drop the oldest frame of the lane that holds most bytes. There must be one."""
        oldest = max(self.queues, key=attrgetter("size")).oldest()
        assert oldest is not None
        self.drop(oldest, EgressDrop.OVERFLOW)

    def pop(self, room: float, now: float, *, only_urgent: bool) -> list[Frame]:
        """Take out the frames of one envelope: the first, and others while there is room. There must be one."""
        batch: list[Waiting] = []
        waiting = self.next()
        while waiting is not None and ((room := room - len(waiting.frame.raw)) >= 0 or not batch):
            self.serve(waiting, now)
            batch.append(waiting)
            waiting = self.next_urgent() if only_urgent else self.next()
        # The turns decide which frames go. Within the envelope they are in the order of arrival.
        return [popped.frame for popped in sorted(batch, key=by_number)]

    def pop_all(self) -> list[Waiting]:
        """Take out all frames that wait, in the order of arrival."""
        arrivals = (waiting for queue in self.queues for waiting in queue.arrivals if waiting.is_waiting)
        popped = sorted(arrivals, key=by_number)
        for waiting in popped:
            self.queues[waiting.flow.lane].remove(waiting)
        return popped

    def oldest_at(self, otherwise: float) -> float:
        """Since when the oldest frame waits."""
        return min((oldest.put_at for queue in self.queues if (oldest := queue.oldest())), default=otherwise)

    def clear(self) -> None:
        for waiting in self.pop_all():
            self._on_drop(waiting, EgressDrop.CLOSED)

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
