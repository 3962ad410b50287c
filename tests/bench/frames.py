"""The frames that are carried: those of a vehicle in a recorded flight, in their order; some carry the time.

Each :data:`PROBE_EVERY`-th is a MAVLink PING to everybody, whose time is the sender's monotonic clock in nanoseconds:
what receives it on the same machine knows how long it took.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Final

from fastcrc.crc16 import mcrf4xx

from tests.tlog import read_tlog
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.policy.compilation import Policy

MAVLINK2: Final = 0xFD
PROBE_EVERY: Final = 20
SYSTEM: Final = 1
"""The vehicle whose frames they are."""
FLIGHT: Final = Path(__file__).parents[3] / "shared" / "data" / "arducopter_sitl_flight.tlog"
"""Recorded in ArduPilot's simulator; no part of this repository."""
MOST_FRAMES: Final = 20_000
HEADER_BYTES: Final = 10
"""Of MAVLink 2. Start, length, two bytes of flags, sequence, system, component, three bytes of message."""
CHECKSUM_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
PING: Final = 4
# time in microseconds 8, sequence 4; target system and component are 0, for all, and so left out, as senders do
_PING_PAYLOAD: Final = struct.Struct("<QI")
_PING_EXTRA: Final = bytes([MESSAGES[PING][1]])
PROBE_BYTES: Final = HEADER_BYTES + _PING_PAYLOAD.size + CHECKSUM_BYTES
PROBE_START: Final = bytes([MAVLINK2, _PING_PAYLOAD.size])
_PROBE_NUMBER: Final = 0xC0FF_EE00  # its highest byte is not 0, so the payload has its full length


@dataclass(frozen=True, slots=True)
class FrameSet:
    """Frames to carry, over and over, and where they are from."""

    frames: tuple[bytes, ...]
    times_s: tuple[float, ...]
    """When the vehicle sent each of them, from the first one on."""
    source: str

    @property
    def mean_bytes(self) -> float:
        """The size of a frame on average, with those that carry the time."""
        return sum(map(len, self.frames)) / len(self.frames)


@cache
def load_frames(flight: Path = FLIGHT) -> FrameSet:
    """The vehicle's frames of the recorded flight; where it is not there, those of the simulated autopilot.

    Without what a ground station's daemon would not take from a vehicle, what the dialect does not have, and what is
    for one system alone: routers drop that until they have received a frame of the other.
    """
    said: Iterable[tuple[float, bytes]] = _simulated()
    source = "a flight of `uavlinkd sim`, as no recorded one is there"
    if flight.exists():
        said = ((record.time_us / 1e6, record.frame) for record in read_tlog(flight))
        source = f"{flight.name}: a recorded flight"
    frames = list(islice(_carried(said), MOST_FRAMES))
    whole = len(frames) - len(frames) % (PROBE_EVERY - 1)
    mixed: list[tuple[float, bytes]] = []
    for start in range(0, whole, PROBE_EVERY - 1):
        mixed += [(frames[start][0], bytes(probe())), *frames[start : start + PROBE_EVERY - 1]]
    began_at = mixed[0][0]
    return FrameSet(tuple(raw for _, raw in mixed), tuple(at - began_at for at, _ in mixed), source)


def _carried(said: Iterable[tuple[float, bytes]]) -> Iterable[tuple[float, bytes]]:
    gate = Policy({"role": "vehicle", "system_ids": [SYSTEM]}).incoming
    passes = {message for message in MESSAGES if gate.decide(message, is_known=True) is None} - {PING}
    return ((at, raw) for at, raw in said if _is_plain(raw) and message_of(raw) in passes and not _has_target(raw))


def _is_plain(raw: bytes) -> bool:
    """Whether it is one whole frame of MAVLink 2 by the vehicle, without a signature."""
    return raw[0] == MAVLINK2 and not raw[2] and raw[5] == SYSTEM and length_at(raw, 0) == len(raw)


def _has_target(raw: bytes) -> bool:
    at = MESSAGES[message_of(raw)][4]  # of target_system in the payload; what senders cut off there is 0
    return at is not None and at < raw[1] and raw[HEADER_BYTES + at] != 0


def message_of(raw: bytes) -> int:
    """The number of a MAVLink 2 frame's message."""
    return int.from_bytes(raw[7:HEADER_BYTES], "little")


def _simulated() -> Iterable[tuple[float, bytes]]:
    from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings

    autopilot = Autopilot(AutopilotSettings(system_id=SYSTEM))
    for tick in range(100_000):
        yield from ((tick * 0.01, raw) for raw in autopilot.advance(tick * 0.01))


def probe(system: int = SYSTEM) -> bytearray:
    """A frame that will carry the time; :func:`stamp` puts it in."""
    header = bytes([*PROBE_START, 0, 0, 0, system, 1, PING, 0, 0])
    frame = bytearray(header + _PING_PAYLOAD.pack(0, _PROBE_NUMBER) + bytes(CHECKSUM_BYTES))
    stamp(frame, 0, 0)
    return frame


def stamp(datagram: bytearray, offset: int, now_ns: int) -> None:
    """Put the time into the probe at this offset, and the checksum that fits."""
    struct.pack_into("<Q", datagram, offset + HEADER_BYTES, now_ns)
    end = offset + PROBE_BYTES - CHECKSUM_BYTES
    struct.pack_into("<H", datagram, end, mcrf4xx(bytes(datagram[offset + 1 : end]) + _PING_EXTRA))


def is_probe(frame: bytes | bytearray) -> bool:
    """Whether this frame carries the time."""
    return frame[:2] == PROBE_START and frame[7:HEADER_BYTES] == bytes([PING, 0, 0])


def said_by(frame: bytes, system: int) -> bytes:
    """The same frame of MAVLink 2 by another system."""
    changed = bytearray(frame)
    changed[5] = system
    extra = MESSAGES[message_of(frame)][1]
    end = HEADER_BYTES + frame[1]
    struct.pack_into("<H", changed, end, mcrf4xx(bytes(changed[1:end]) + bytes([extra])))
    return bytes(changed)


def length_at(datagram: bytes, offset: int) -> int:
    """Of the frame that begins there; 0 where none does."""
    match datagram[offset]:
        case 0xFD:
            signed = SIGNATURE_BYTES if datagram[offset + 2] & 1 else 0
            return HEADER_BYTES + datagram[offset + 1] + CHECKSUM_BYTES + signed
        case 0xFE:
            return 6 + datagram[offset + 1] + CHECKSUM_BYTES
    return 0


def write_frames(path: Path, frames: FrameSet) -> None:
    """For the generator: their times, and then the frames, back to back; their headers say where each ends."""
    times = array("d", frames.times_s)
    path.write_bytes(len(times).to_bytes(4, "little") + times.tobytes() + b"".join(frames.frames))


def read_frames(path: Path) -> tuple[list[bytes], list[float]]:
    """The frames, and when the vehicle sent each of them."""
    content, frames, offset = path.read_bytes(), list[bytes](), 0
    end = 4 + 8 * int.from_bytes(content[:4], "little")
    times, data = array("d", content[4:end]), content[end:]
    while offset < len(data):
        size = length_at(data, offset)
        frames.append(data[offset : offset + size])
        offset += size
    return frames, times.tolist()
