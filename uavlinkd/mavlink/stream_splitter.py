"""Frames out of a byte stream (serial, TCP, a bridge on UDP), however it is cut into chunks."""

from __future__ import annotations

from math import inf
from typing import Final

from uavlinkd.mavlink.frames import Frame, SplitCounters, find_frames

MAX_GAP_S: Final = 0.5
"""Longer than a serial line holds back the rest of a frame, shorter than any failsafe."""


class StreamSplitter:
    """Splits one stream into frames. Holds less than one frame.

    A stray start byte makes the following bytes look like a frame of up to 280 bytes, and valid frames would wait
    until that many bytes have arrived: with one heartbeat per second, beyond every failsafe. But a sender writes a
    frame without pauses. So a frame counts as broken after a silence of ``max_gap_s`` inside it, or if the rest of it
    has not arrived within ``max_hold_s`` of the last progress. The splitter notices it at the next chunk, or when
    :meth:`give_up` is called.

    With ``gives_up``, the rest of a chunk of false starts is garbage, as in a datagram. This bounds its cost.
    """

    def __init__(
        self,
        counters: SplitCounters | None = None,
        max_gap_s: float = MAX_GAP_S,
        max_hold_s: float = inf,
        *,
        gives_up: bool = False,
    ) -> None:
        self.counters = SplitCounters() if counters is None else counters
        self._max_gap_s = max_gap_s
        self._max_hold_s = max_hold_s
        self._held_since = 0.0
        self._gives_up = gives_up
        self._rest = b""
        self._in_garbage = False
        self._fed_at = 0.0
        self._fresh_bytes = 0

    @property
    def is_fresh(self) -> bool:
        """Whether all held bytes arrived after the last :meth:`age`."""
        return len(self._rest) <= self._fresh_bytes

    def age(self) -> None:
        """Mark the held bytes as old, and so a frame that begins in them."""
        self._fresh_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes held because they may be the start of a frame. Below MAX_FRAME_BYTES."""
        return len(self._rest)

    def feed(self, chunk: bytes, now: float) -> list[Frame]:
        """The frames that this chunk completes, for any bytes. ``now`` is monotonic seconds."""
        frames = self.give_up(now)
        held = len(self._rest)
        self._fed_at = now
        self._fresh_bytes += len(chunk)
        if self._find(self._rest + chunk if held else chunk, frames, is_final=False) or not held:
            self._held_since = now
        return frames

    def give_up(self, now: float) -> list[Frame]:
        """The frames in the held bytes, if these begin with a broken frame: they need not wait for the next chunk."""
        frames: list[Frame] = []
        is_over = now - self._fed_at > self._max_gap_s or now - self._held_since > self._max_hold_s
        if self._rest and is_over:
            self._find(self._rest, frames, is_final=True)
        return frames

    def end(self) -> list[Frame]:
        """The frames in the held bytes, when the stream has ended. The splitter is then as new."""
        frames: list[Frame] = []
        self._find(self._rest, frames, is_final=True)
        self._in_garbage = False
        return frames

    def _find(self, data: bytes, frames: list[Frame], *, is_final: bool) -> int:
        consumed, self._in_garbage = find_frames(
            data,
            frames,
            self.counters,
            in_garbage=self._in_garbage,
            is_final=is_final,
            gives_up=is_final or self._gives_up,
        )
        self._rest = data[consumed:]
        return consumed
