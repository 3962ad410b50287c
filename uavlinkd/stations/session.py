"""One session of WireGuard with a station: its keys, its counters, and the evidence that what it carries is new."""

from __future__ import annotations

from struct import Struct
from typing import Final

from uavlinkd.protocol.counters import ReplayWindow
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.stations.handshake import TunnelKeys

DATA: Final = b"\4\0\0\0"
"""How a data message begins: type, receiver's index (4), counter (8), sealed packet, tag (16). Section 5.4.6."""
HEADER_BYTES: Final = 16
TAG_BYTES: Final = 16
REJECT_AFTER_S: Final = 180.0
"""The age at which a session ends (whitepaper, section 6.1)."""
MOST_MESSAGES: Final = 2**64 - 2**13 - 1
"""The counters of a session (section 6.1)."""
MOST_AGE_S: Final = 5.0
"""The oldest frame that counts as new: the bound for peers is 5.5 s."""
PROOFS: Final = 8
"""Answers that are remembered: more than arrive in :data:`MOST_AGE_S` while nothing is in doubt."""
_HEADER: Final = Struct("<4sIQ")
_PADDING: Final = bytes(15)


class TunnelSession:
    """The keys of one handshake and what they carry. All times are monotonic seconds."""

    __slots__ = ("_proofs", "_sent", "_window", "born_at", "ends_at", "index", "is_initiator", "keys")

    def __init__(self, index: int, keys: TunnelKeys, born_at: float, since: float, *, is_initiator: bool) -> None:
        """``since``: what comes with these keys was sent by the station's software after this time."""
        self.index = index
        self.keys = keys
        self.born_at = born_at
        """When this daemon sent its message of the handshake: the station has the keys only since then."""
        self.ends_at = born_at + REJECT_AFTER_S
        self.is_initiator = is_initiator
        self._sent = 0
        self._window = ReplayWindow()
        self._proofs = [(-1, since)]

    def is_over(self, now: float) -> bool:
        """Whether its keys are too old to send and to receive."""
        return now >= self.ends_at or self._sent >= MOST_MESSAGES

    @property
    def highest(self) -> int:
        """The highest counter that was opened, -1 before the first."""
        return self._window.highest

    @property
    def proved_at(self) -> float:
        """The newest time after which the station sent what comes from now on."""
        return self._proofs[-1][1]

    def seal(self, packet: bytes) -> bytes:
        """The data message with an inner packet, padded to 16 bytes; empty: a keepalive."""
        counter = self._sent
        self._sent += 1
        header = _HEADER.pack(DATA, self.keys.remote_index, counter)
        return header + self.keys.send.seal(counter, packet + _PADDING[: -len(packet) % 16], b"")

    def open(self, datagram: bytes, now: float) -> tuple[int, bytes]:
        """Counter and inner packet of a data message. Raises ``SESSION_EXPIRED``, ``REPLAYED`` or ``BAD_TAG``."""
        if now >= self.ends_at:
            raise Drop(DropReason.SESSION_EXPIRED)
        counter = int.from_bytes(datagram[8:HEADER_BYTES], "little")
        window = self._window
        if counter >= MOST_MESSAGES or (counter <= window.highest and window.is_used(counter)):
            raise Drop(DropReason.REPLAYED)
        packet = self.keys.receive.open(counter, memoryview(datagram)[HEADER_BYTES:], b"")
        if packet is None:
            raise Drop(DropReason.BAD_TAG)
        window.mark(counter)
        return counter, packet

    def prove(self, counter: int, asked_at: float) -> None:
        """The station sent what has a higher counter after ``asked_at``."""
        if asked_at > self._proofs[-1][1]:
            self._proofs.append((counter, asked_at))
            del self._proofs[:-PROOFS]

    def is_new(self, counter: int, now: float) -> bool:
        """Whether the packet with this counter is at most :data:`MOST_AGE_S` old."""
        return any(counter > proof and now - at <= MOST_AGE_S for proof, at in self._proofs)
