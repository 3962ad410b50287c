"""What a TCP connection and a serial line have in common, as the kernel offers it."""

from __future__ import annotations

from typing import Protocol


class ByteChannel(Protocol):
    """The kernel's side of one connection. No method blocks."""

    def fileno(self) -> int:
        """The file descriptor, for the event loop."""

    def read(self, size: int) -> bytes:
        """The received bytes, up to ``size``; no bytes at the end of the stream.

        Raises:
            BlockingIOError: no bytes are there now.
        """

    def write(self, data: bytes) -> int:
        """Pass bytes to the kernel. Returns how many it accepted.

        Raises:
            BlockingIOError: it accepts no bytes now.
        """

    def capacity(self) -> int:
        """How many received bytes the kernel can hold now."""

    @property
    def limit_bytes(self) -> int:
        """The kernel gets no more than this, except for a single larger frame while it holds no bytes."""

    def held(self, now: float) -> int:
        """How many of the kernel's bytes count towards the limit."""

    def drain_s(self, to_bytes: int, now: float) -> float:
        """After how many seconds the kernel should hold no more than ``to_bytes``."""

    def close(self, *, abort: bool) -> None:
        """Close it; ``abort`` discards the kernel's unsent bytes."""
