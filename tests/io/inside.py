"""What tests of other rooms see and set inside the endpoints: only this folder names their private attributes."""

from __future__ import annotations

from uavlinkd.tls.stream import WebStream


def held_bytes(stream: WebStream) -> int:
    """The number of bytes that a stream holds of a message that has not ended."""
    return len(stream._protocol.reader.buffer)
