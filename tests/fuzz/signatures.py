"""The wire to an autopilot with signing: honest frames, and whatever somebody on the wire makes of them.

The autopilot signs, follows timestamps and answers questions. The script delivers its frames late, twice or never,
alters them, returns those of the daemon, and makes frames of its own; stations send anything.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

from fastcrc.crc16 import mcrf4xx

from tests.fuzz.engine import Run, Script, play
from tests.fuzz.frames import LAST_STEPS, made
from tests.mavlink.signing.wire import KEY
from tests.samples import ID, build
from uavlinkd.config.model import LINK_ID
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import Frame, parse_frame
from uavlinkd.mavlink.signing.endpoint_signing import MOST_SENDERS, EndpointSigning
from uavlinkd.mavlink.signing.signature import Signer, is_signed, without_signature

MOST_RECORDED: Final = 64
_HONEST: Final = Signer(KEY)
_ASKER: Final = bytes((51, 240))
"""System and component of the daemon's questions."""


def timestamp_of(raw: bytes) -> int:
    """The timestamp of a signed frame."""
    return int.from_bytes(raw[-12:-6], "little")


def _crc_is_right(raw: bytes) -> bool:
    """Whether a frame's checksum fits its message, or any definition."""
    end = 10 + raw[1]
    wanted = int.from_bytes(raw[end : end + 2], "little")
    known = MESSAGES.get(int.from_bytes(raw[7:10], "little"))
    if known and mcrf4xx(raw[1:end] + bytes((known[1],))) == wanted:
        return True
    return mcrf4xx(raw[1:end]) >> 8 ^ wanted in LAST_STEPS


class Wire:
    """A daemon's end, an honest autopilot, and the attacker between them."""

    def __init__(self) -> None:
        self._drops = Counter[str]()
        self._numbers = 0
        self._now = 0.0
        self._autopilot = 5  # its timestamp
        self._heard: dict[bytes, int] = {}  # by sender: the last that it accepted
        self._recorded: list[bytes] = []  # of the autopilot, the newest last
        self._sent: list[bytes] = []  # of the daemon
        self._passed = 0  # the timestamp of the last frame that passed
        self._signed = 0
        self._start()

    def _start(self) -> None:
        self._signing = EndpointSigning(KEY, LINK_ID, self._random, self._drops)
        self._signing.send = self._leave
        self._signed = 0  # it begins again, and follows the autopilot

    def _random(self, size: int) -> bytes:
        self._numbers += 1
        return (self._numbers * 2**16 + 257).to_bytes(size, "little")

    # The ends.

    def _leave(self, raw: bytes) -> None:
        frame = parse_frame(raw)
        assert frame is not None
        was_proven, before = self._signing.is_proven, self._drops.total()
        frames = self._signing.sign([frame], str(raw[5]))
        if not frames:
            assert self._drops.total() == before + 1, "a frame is missing, and not counted"
            return
        (signed,) = frames
        assert was_proven or frame.raw[5:7] == _ASKER, "a frame leaves before an answer"
        assert _HONEST.read(signed.raw) is not None, "the autopilot rejects the signature"
        assert _crc_is_right(signed.raw), "the autopilot rejects the checksum"
        assert signed.raw[-13] == LINK_ID
        assert timestamp_of(signed.raw) > self._signed, "a timestamp that does not grow"
        self._signed = timestamp_of(signed.raw)
        bare = without_signature(frame.raw) if is_signed(frame.raw) else frame.raw
        assert without_signature(signed.raw) == bare, "a frame is altered"
        self._sent = [*self._sent[-MOST_RECORDED:], signed.raw]

    def _make(self, message: int, payload: bytes) -> bytes:
        raw = _HONEST.sign(build(message, payload), 3, self._autopilot)
        self._autopilot += 1
        self._recorded = [*self._recorded[-MOST_RECORDED:], raw]
        return raw

    def _to_autopilot(self, raw: bytes) -> None:
        if timestamp_of(raw) <= self._heard.get(raw[5:7], 0):
            return
        self._heard[raw[5:7]] = timestamp_of(raw)
        self._autopilot = max(self._autopilot, timestamp_of(raw))
        if int.from_bytes(raw[7:10], "little") == ID["TIMESYNC"]:
            self._make(ID["TIMESYNC"], (9).to_bytes(8, "little") + raw[18 : 10 + raw[1]].ljust(8, b"\0"))

    def _to_daemon(self, frames: list[Frame]) -> None:
        was_proven, before = self._signing.is_proven, self._drops.total()
        passed = self._signing.accept(frames, self._now)
        dropped = self._drops.total() - before
        assert len(passed) + dropped <= len(frames) <= len(passed) + dropped + 1, (
            "a frame is missing, or counted twice"
        )
        assert not passed or was_proven or self._signing.is_proven, "a frame passes before an answer"
        genuine = {without_signature(raw): timestamp_of(raw) for raw in self._recorded}
        for frame in passed:
            assert frame.raw in genuine, "a frame passes that the autopilot did not make"
            assert genuine[frame.raw] > self._passed, "a frame passes again, or late"
            self._passed = genuine[frame.raw]

    # The script.

    def step(self, script: Script) -> None:
        how, at = script.byte(), script.byte()
        self._now += 0.1
        pick = self._recorded[-1 - at % len(self._recorded)] if self._recorded else b""
        match how & 15:
            case 0 | 1 | 2:  # a new frame arrives, or two
                raws = [
                    self._make(ID["ATTITUDE"], self._autopilot.to_bytes(8, "little") * 3)
                    for _ in range(1 + (how >> 7))
                ]
            case 3:  # and is withheld
                self._make(ID["HEARTBEAT"], self._autopilot.to_bytes(8, "little") + b"\3")
                return
            case 4 | 5:
                raws = [pick] if pick else []
            case 6:
                raws = [self._sent[-1 - at % len(self._sent)]] if self._sent else []
            case 7 | 8 if pick:
                altered = bytearray(pick)
                altered[script.byte() % len(altered)] ^= 1 + at % 255
                raws = [bytes(altered)]
            case 9 | 10 if self._sent:
                self._to_autopilot(self._sent[-1 - (at % len(self._sent) if how & 128 else 0)])
                return
            case 11 | 12:
                self._leave_any(made(script))
                return
            case 13 if how & 0xF0 == 0xF0:
                self._start()
                return
            case 14 if how & 0xC0 == 0xC0 and self._signed < 2**46:
                self._autopilot += script.long() << 8
                return
            case _:
                raws = [made(script)]
        self._to_daemon([frame for raw in raws if (frame := parse_frame(raw)) is not None])

    def _leave_any(self, raw: bytes) -> None:
        if parse_frame(raw) is not None:
            self._leave(raw)

    def check_bounds(self) -> None:
        """The autopilot has room for all senders of the last daemon."""
        assert len({raw[5:7] for raw in self._sent if raw[5:7] != _ASKER}) <= 2 * MOST_SENDERS

    def check_sequel(self) -> None:
        """The autopilot's next frame proves it, or the answer to the question that it causes."""
        for _ in range(3):
            self._now += 1.0
            self._to_daemon([self._read(self._make(ID["ATTITUDE"], self._autopilot.to_bytes(8, "little") * 3))])
            if not self._signing.is_proven:
                self._to_autopilot(self._sent[-1])
                self._to_daemon([self._read(self._recorded[-1])])
        assert self._signing.is_proven, "no frame passes any more"
        before = self._passed
        self._to_daemon([self._read(self._make(ID["ATTITUDE"], self._autopilot.to_bytes(8, "little") * 3))])
        assert self._passed > before, "an honest frame does not pass"

    @staticmethod
    def _read(raw: bytes) -> Frame:
        frame = parse_frame(raw)
        assert frame is not None
        return frame


def make() -> Run:
    """The target ``signing``."""
    return play([Wire])
