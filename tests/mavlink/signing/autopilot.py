"""An autopilot that judges what a daemon signed by pymavlink's rules, and answers as ArduPilot or PX4 do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

ARMED = 128
NO_KEY = bytes(32)
MINUTE = 6_000_000
ALWAYS_UNSIGNED = {"ardupilot": {109, 166}, "px4": {0, 109, 246, 247}}


class Autopilot:
    """System 1. ``kind``: what it accepts unsigned, and what it remembers over a restart.

    ArduPilot saves its timestamp every 30 s and adds a minute (libraries/GCS_MAVLink/GCS_Signing.cpp). PX4 remembers
    the timestamp that came with the key (docs.px4.io, MAVLink Message Signing).
    """

    def __init__(self, kind: str = "ardupilot", *, is_usb: bool = False, system: int = 1) -> None:
        self._kind, self._system = kind, system
        self.is_usb = is_usb
        """Whether it accepts everything unsigned, as ArduPilot does on its USB port."""
        self.is_armed = False
        self.is_deaf = False
        """Whether it gets nothing that is sent to it."""
        self.accepted: list[Any] = []
        """The messages that came, without questions and keys."""
        self.rejected = Counter[str]()
        self._stored = (NO_KEY, 0)
        self._saved = 0
        self._sequence = 0
        self._start()

    def _start(self) -> None:
        self._codec = mavlink.MAVLink(None, self._system, 1)
        self._codec.robust_parsing = True
        self._codec.signing.allow_unsigned_callback = self._accepts_unsigned
        self._codec.signing.link_id = 3
        self._use(*self._stored)

    def _use(self, key: bytes, timestamp: int) -> None:
        has_key = key != NO_KEY or timestamp != 0
        signing = self._codec.signing
        signing.secret_key, signing.sign_outgoing = key if has_key else None, has_key
        signing.timestamp = self._saved = timestamp

    def _accepts_unsigned(self, _: Any, msgid: int) -> bool:
        return self.is_usb or msgid in ALWAYS_UNSIGNED[self._kind]

    @property
    def key(self) -> bytes | None:
        key: bytes | None = self._codec.signing.secret_key
        return key

    @property
    def has_key(self) -> bool:
        return self.key is not None

    def save(self) -> None:
        """Store the timestamp, as ArduPilot does every 30 s."""
        self._saved = max(self._saved, self._codec.signing.timestamp)

    def set_time(self, timestamp: int) -> None:
        """Take a later time: from satellites."""
        self._codec.signing.timestamp = max(self._codec.signing.timestamp, timestamp)

    def restart(self) -> None:
        """Restart with what is stored."""
        key, first = self._stored
        saved = self._saved + MINUTE if self._kind == "ardupilot" and key != NO_KEY else first
        self._start()
        self._codec.signing.timestamp = saved
        self._saved = max(self._saved, saved)

    def erase(self) -> None:
        """Restart without a key."""
        self._stored, self._saved = (NO_KEY, 0), 0
        self._start()

    def heartbeat(self) -> bytes:
        mode = ARMED if self.is_armed else 0
        return self.send(mavlink.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))

    def send(self, message: Any) -> bytes:
        raw = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        return raw

    def receive(self, data: bytes) -> list[bytes]:
        """Judge frames. Returns the answers."""
        if self.is_deaf:
            return []
        answers: list[bytes] = []
        for message in self._judged(data):
            kind = message.get_type()
            if kind == "TIMESYNC" and message.tc1 == 0:
                answers.append(self.send(mavlink.MAVLink_timesync_message(7, message.ts1)))
            elif kind == "SETUP_SIGNING":
                if not self.is_armed:
                    self._stored = bytes(message.secret_key), message.initial_timestamp
                    self._use(*self._stored)
            else:
                self.accepted.append(message)
        return answers

    def _judged(self, data: bytes) -> Iterator[Any]:
        """The messages that it accepts. The others are counted."""
        for message in self._codec.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                is_unsigned = message.data[:1] == b"\xfd" and not message.data[2] & 1
                self.rejected["unsigned" if is_unsigned else message.reason] += 1
            else:
                yield message
