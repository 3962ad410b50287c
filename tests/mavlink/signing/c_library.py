"""An autopilot that judges, signs and answers by MAVLink's C library, which ArduPilot and PX4 contain."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.parsers.receivers import compile_shared
from tests.mavlink.signing.autopilot import ALWAYS_UNSIGNED, MINUTE, NO_KEY, Autopilot

OK: Final = 1
"""Of MAVLINK_FRAMING: the autopilot acts on this frame."""
BAD_CRC: Final = 2
"""Of MAVLINK_FRAMING: also an unknown message."""
VERIFIED: Final = 1
OLD: Final = 5
"""Of MAVLINK_SIGNING_STATUS."""
SIGNATURES: Final = ("unsigned", "ok", "bad signature", "no streams", "too many streams", "old timestamp", "replay")
"""MAVLINK_SIGNING_STATUS by number."""
LINK: Final = 3
_ROOM: Final = 64
_MOST_BYTES: Final = 280


class Verdict(NamedTuple):
    """The library's result for one frame."""

    framing: int
    signature: int
    end: int  # offset behind the frame
    message: int


class _Verdict(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int32) for name in ("framing", "signature", "end", "message")]


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(compile_shared(Path(__file__).with_name("c_library.c"), "all", "2.0")))
    library.timestamp_of.restype = ctypes.c_uint64
    return library


class CAutopilot(Autopilot):
    """As :class:`.Autopilot`, with the library's parser, check of signatures, 16 senders and own signatures."""

    def _start(self) -> None:
        self._c = _library()
        self._state = (ctypes.c_byte * self._c.autopilot_bytes())()
        self._verdicts = (_Verdict * _ROOM)()
        self._out = (ctypes.c_uint8 * _MOST_BYTES)()
        ids = sorted(ALWAYS_UNSIGNED[self._kind])
        self._c.start(self._state, (ctypes.c_uint32 * len(ids))(*ids), len(ids))
        self._codec = mavlink.MAVLink(None, self._system, 1)
        self._use(*self._stored)

    def _use(self, key: bytes, timestamp: int) -> None:
        self._key = key if key != NO_KEY or timestamp else None
        first = timestamp + MINUTE * (self._kind == "ardupilot")
        self._saved = timestamp
        self._c.use(self._state, self._key, ctypes.c_uint64(first), LINK, self.is_usb)

    @property
    def key(self) -> bytes | None:
        return self._key

    @property
    def timestamp(self) -> int:
        return int(self._c.timestamp_of(self._state))

    def save(self) -> None:
        self._saved = max(self._saved, self.timestamp)

    def set_time(self, timestamp: int) -> None:
        if timestamp > self.timestamp:
            self._c.use(self._state, self._key, ctypes.c_uint64(timestamp), LINK, self.is_usb)
            self.save()

    def restart(self) -> None:
        key, first = self._stored
        self._stored = key, max(first, self._saved) if self._kind == "ardupilot" and key != NO_KEY else first
        self._start()

    def send(self, message: Any) -> bytes:
        raw = bytes(message.pack(self._codec, force_mavlink1=False))
        return self.send_payload(message.id, raw[10:-2], message.crc_extra)

    def send_payload(self, message: int, payload: bytes, crc_extra: int) -> bytes:
        """A frame of this autopilot, signed if it has a key."""
        length = self._c.send(self._state, self._system, message, payload, len(payload), crc_extra, self._out)
        return bytes(self._out[:length])

    def judge(self, data: bytes) -> list[Verdict]:
        """The library's results for the frames in these bytes. The autopilot does nothing else."""
        count = self._c.receive(self._state, data, len(data), self._verdicts, _ROOM)
        return [Verdict(v.framing, v.signature, v.end, v.message) for v in self._verdicts[:count]]

    def _judged(self, data: bytes) -> Iterator[Any]:
        begin = 0
        for verdict in self.judge(data):
            raw, begin = data[begin : verdict.end], verdict.end
            if verdict.framing == OK:
                yield mavlink.MAVLink(None).decode(bytearray(raw))
            else:
                self.rejected[SIGNATURES[verdict.signature]] += 1
