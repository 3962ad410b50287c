"""One lane of a slow link: the frames that wait, and whose turn it is. :mod:`.budgeted` has clock and budget."""

from __future__ import annotations

from collections import deque
from heapq import heapify, heappop, heappush

from uavlinkd.mavlink.classes import Lane, MessageKind
from uavlinkd.mavlink.frames import Frame


class Waiting:
    """One frame that waits."""

    __slots__ = ("flow", "frame", "is_waiting", "number", "put_at")

    def __init__(self, frame: Frame, flow: Flow, put_at: float, number: int) -> None:
        self.frame = frame
        self.flow = flow
        self.put_at = put_at
        self.number = number  # in the order of arrival
        self.is_waiting = True


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
        """Put a frame at the end of its flow, and the flow in line."""
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
        """Put the flow in line."""
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
        """Take out the first frame of a flow."""
        frame.flow.frames.popleft()
        frame.flow.size -= len(frame.frame.raw)
        frame.is_waiting = False
        self.count -= 1
        self.size -= len(frame.frame.raw)

    def serve(self, frame: Waiting, now: float) -> None:
        """Take out the first frame of a flow to be sent, which is the flow's turn."""
        flow = frame.flow
        self.remove(frame)
        flow.sent_at = now
        if flow.frames:
            flow.since = flow.frames[0].put_at
