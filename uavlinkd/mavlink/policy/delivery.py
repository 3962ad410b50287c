"""Delivery of frames to one local client: their sources, and the byte stream that the client reads.

The invariant: *in the byte stream delivered to a client, no byte offset other than the start of a frame that policy
passed begins a valid MAVLink frame that policy would not pass from the same source.* What is valid is in
:mod:`.hidden`. The stream counts, not the datagram: a parser keeps its state from one datagram to the next.

Without it a captured peer puts a forbidden frame into the payload of an allowed one. A parser that reads bytes
differently than this daemon (another dialect, MAVLink 1 only, a byte lost) then accepts the forbidden frame.

A frame that contains a hidden frame is refused (:attr:`Refusal.HIDDEN_FRAME`). One that completes a hidden frame
which began in an earlier frame is delivered behind separator bytes, which end the hidden frame before it is complete.
So a source cannot cause the refusal of another's frame, and an accident of random bytes seldom costs a frame. A
source cannot have a parser swallow another's urgent frame either: where the receiver may have rejected another
source's frame, and resumed at a start byte in it, separator bytes end what it reads there.

A hidden frame that every source of its bytes may send is harmless: the download of a recorded flight carries whole
frames of the vehicle itself. Rates do not apply to hidden frames. Dialects that the daemon does not know are a limit:
a receiver with a private definition may accept bytes that are not a frame here, unless a policy lets unknown
messages pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, final

from uavlinkd.mavlink.dialect import MESSAGES, Lane
from uavlinkd.mavlink.frames import MAVLINK1, MAX_FRAME_BYTES, Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy import hidden
from uavlinkd.mavlink.policy.gate import Gate, Refusal

LAST_COMMON_ID: Final = 149
"""Receivers of any dialect but ``minimal`` have the messages up to this number, and reject none of them but these."""
NOT_COMMON_IDS: Final = frozenset((8, 53, 80))
"""LINK_NODE_STATUS, MISSION_CHECKSUM and COMMAND_CANCEL: ArduPilot lacks them."""

MAX_STREAMS: Final = 64
"""Clients of one endpoint whose streams are remembered: twice as many as it serves."""

Report = Callable[[str, Header, Refusal, float], None]
"""Receives each refusal: the source's name, the header of the frame that was not delivered, why, and when."""

Forget = Callable[[bytes], None]
"""Receives the bytes of a frame that was not delivered: the same frame from another source is not its duplicate."""


@final
class Source:
    """One port that frames come from, as the ports that they go to know it. Compared by identity."""

    __slots__ = ("_forget", "_refused", "_report", "gate", "name")

    def __init__(self, name: str, gate: Gate, report: Report | None = None, forget: Forget | None = None) -> None:
        self.name = name  # the peer or endpoint, as the configuration names it
        self.gate = gate  # the incoming rules that its frames passed
        self._report = report
        self._forget = forget
        self._refused: Frame | None = None

    def refuse(self, frame: Frame, now: float) -> None:
        """Count and report a frame that carries hidden ones: once, whatever the number of its clients."""
        if frame is self._refused:
            return
        self._refused = frame
        self.gate.count(frame.header, Refusal.HIDDEN_FRAME)
        if self._forget is not None:
            self._forget(frame.raw)
        if self._report is not None:
            self._report(self.name, frame.header, Refusal.HIDDEN_FRAME, now)


class DeliveredStream:
    """The bytes that one client has been sent, as far as a hidden frame may still begin in them.

    Call :meth:`admit` once for each frame, in the order of delivery, and deliver all of what it returns.
    """

    __slots__ = ("_authors", "_due_at", "_has_mavlink2", "_has_rare", "_tail", "outgoing", "separators", "starts")

    def __init__(self, outgoing: Gate | None = None) -> None:
        self.outgoing = outgoing
        """The rules for what goes to this client; None where nothing is withheld."""
        self.separators = 0  # how often bytes had to be put between frames of different sources
        self._tail = b""  # the stream from the first start that is still open
        self.starts: list[hidden.Start] = []
        """Where in the stream frames may have begun that are not complete."""
        self._has_mavlink2 = self._has_rare = False  # whether the tail has such frames: some receivers reject them
        self._due_at = 0  # the tail's length at which the first of them may be complete
        self._authors: list[tuple[int, Source | None]] = []  # up to where in it whose bytes go; None: a separator

    @property
    def opened_by(self) -> Source | None:
        """The source of the first frame that may still be open: separator bytes are put there because of it."""
        return self._authors[0][1] if self._authors else None

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """The bytes to deliver for a frame: itself, perhaps behind separator bytes. None of them: it is refused."""
        raw = frame.raw
        if raw.count(b"\xfd") + raw.count(b"\xfe") == 1:  # no other start byte but the frame's own
            if not self.starts:
                return raw
            authors = self._authors
            if len(authors) == 1 and authors[0][1] is source and len(self._tail) + len(raw) < self._due_at:
                self._tail += raw
                self._authors = [(len(self._tail), source)]
                return raw
        return self._examine(frame, source, now)

    def _examine(self, frame: Frame, source: Source, now: float) -> bytes:
        raw = frame.raw
        gap = b""
        if self.starts and not self._is_only(source) and _is_urgent(frame) and self._may_be_rejected(frame):
            gap = hidden.separator(self._tail, self.starts)
        while True:
            begun_at = len(self._tail) + len(gap)
            data = self._tail + gap + raw
            authors = [*self._authors, *([(begun_at, None)] if gap else []), (len(data), source)]
            if self._is_only(source) and not gap:
                authors = authors[-1:]
            still_open: list[hidden.Start] = []
            due_at = MAX_FRAME_BYTES + len(data)
            is_hidden_elsewhere = False
            starts = [] if gap else list(self.starts)  # all of them end within the gap
            starts += hidden.starts_in(data, begun_at + 1)
            itself = (begun_at, True) if raw[0] == MAVLINK1 else None
            if itself is not None:
                starts.append(itself)  # for a receiver that rejects it
            causes: dict[hidden.Start, hidden.Start] = {}  # of a restart: what the receiver rejected
            for start in starts:
                end = hidden.end_of_checksum(data, start)
                if end is None or end > len(data):
                    still_open.append(start)
                    due_at = min(due_at, end or 0)
                    continue
                if end == hidden.PAST:
                    continue
                cause = causes.get(start, start)
                # First what rules out almost all: a source can have hundreds of starts in a frame.
                if start != itself and hidden.has_checksum(data, start, end, any_extra=True):
                    if self._is_forbidden(data, start, end, authors):
                        if cause[0] >= begun_at:
                            source.refuse(frame, now)
                            return b""
                        is_hidden_elsewhere = True
                    if (reach := hidden.reach(data, start, end)) > len(data):  # a parser waits for its signature
                        still_open.append(start)
                        due_at = min(due_at, reach)
                again = hidden.restart(data, start, end)
                if again is not None and again not in causes:
                    causes[again] = cause
                    starts.append(again)
            if not is_hidden_elsewhere:
                self._keep(data, still_open, due_at, authors)
                self._note(frame, is_alone=bool(gap))
                self.separators += bool(gap)
                return gap + raw
            # Nothing that began before it goes on behind it: this happens once.
            gap = hidden.separator(self._tail, self.starts)

    def _may_be_rejected(self, frame: Frame) -> bool:
        """Whether a receiver of this frame may have rejected one before it, in which a header is open."""
        return self._has_rare or (self._has_mavlink2 and frame.header.is_mavlink1)

    def _note(self, frame: Frame, *, is_alone: bool) -> None:
        """Remember what kind of frame joined the tail."""
        is_alone = is_alone or len(self._tail) <= len(frame.raw)
        header = frame.header
        msgid = header.msgid
        is_common = header.is_known and msgid <= LAST_COMMON_ID and msgid not in NOT_COMMON_IDS
        # Some receivers reject a payload that is longer than their definition: MAVLINK_CHECK_MESSAGE_LENGTH.
        is_rare = not is_common or frame.raw[1] > MESSAGES[msgid][3]
        self._has_rare = is_rare or (self._has_rare and not is_alone)
        self._has_mavlink2 = not header.is_mavlink1 or (self._has_mavlink2 and not is_alone)

    def _is_forbidden(
        self, data: bytes, start: hidden.Start, end: int, authors: list[tuple[int, Source | None]]
    ) -> bool:
        """Whether a valid frame is there that one of the sources of its bytes may not send, or the client not get."""
        gates = []
        begins_at = 0
        for ends_at, source in authors:
            if source is not None and begins_at < end and start[0] < ends_at:
                gates.append(source.gate)
            begins_at = ends_at
        if not hidden.has_checksum(data, start, end, any_extra=any(gate.passes_unknown for gate in gates)):
            return False
        frame = hidden.frame_at(data, start, end)
        if self.outgoing is not None:
            gates.append(self.outgoing)
        return not all(gate.permits(frame) for gate in gates)

    def _keep(
        self, data: bytes, starts: list[hidden.Start], due_at: int, authors: list[tuple[int, Source | None]]
    ) -> None:
        """Remember the stream from the first of these starts."""
        if not starts:
            self._tail, self.starts, self._authors = b"", starts, []
            return
        first = min(at for at, _ in starts)
        self._tail = data[first:]
        self.starts = [(at - first, is_mavlink1) for at, is_mavlink1 in starts]
        self._due_at = due_at - first
        self._authors = [(ends_at - first, source) for ends_at, source in authors if ends_at > first]

    def _is_only(self, source: Source, start: int = 0) -> bool:
        """Whether all bytes of the tail from `start` on are of this source."""
        return all(author is source for ends_at, author in self._authors if ends_at > start)


class DeliveredStreams:
    """The streams of one endpoint's clients. A client that comes back has the parser that it had.

    A serial device that is plugged in again, a TCP target or a UDP client may go on in the middle of what it read
    before. So its stream is kept by name. Bounded: the client that came back longest ago is forgotten first.
    """

    def __init__(self) -> None:
        self._by_name: dict[str, DeliveredStream] = {}

    def of(self, name: str) -> DeliveredStream:
        """The stream of the client of this name, which is opened now."""
        stream = self._by_name.pop(name, None) or DeliveredStream()
        if len(self._by_name) >= MAX_STREAMS:
            del self._by_name[next(iter(self._by_name))]
        self._by_name[name] = stream
        return stream


def _is_urgent(frame: Frame) -> bool:
    return frame.header.kind.lane is Lane.URGENT
