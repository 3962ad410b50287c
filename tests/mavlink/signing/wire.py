"""The two ends of a cable in virtual time: a daemon's endpoint with its signatures, and an autopilot."""

from __future__ import annotations

from collections import Counter
from random import Random
from typing import TypeVar

from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.signing.autopilot import Autopilot
from tests.samples import pack, read
from uavlinkd.config.model import LINK_ID
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.signing.endpoint_signing import EndpointSigning
from uavlinkd.protocol.crypto import Secret

KEY, OTHER = Secret(b"1" * 32), Secret(b"2" * 32)
STATION = "gcs"
"""A source of frames."""

A = TypeVar("A", bound=Autopilot)


def keyed(autopilot: A, key: Secret = KEY) -> A:
    """The autopilot, after it got this key."""
    autopilot.receive(pack(mavlink.MAVLink_setup_signing_message(1, 1, list(key.reveal()), 5)))
    return autopilot


class Wire:
    """Each frame that one end sends arrives at the other in the same order, unless a test takes it away."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.autopilot = autopilot
        self.drops = Counter[str]()
        self.now = 0.0
        self.recorded: list[bytes] = []
        """Everything that the autopilot sent."""
        self.sent: list[bytes] = []
        """Everything that the daemon sent."""
        self.passed: list[Frame] = []
        """What the daemon accepted from the autopilot."""
        self._random = Random(1)
        self.signing = self.daemon_starts()

    def daemon_starts(self, key: Secret = KEY) -> EndpointSigning:
        """A daemon that remembers nothing of the one before."""
        signing = EndpointSigning(key, LINK_ID, self._random.randbytes, self.drops)
        signing.send = lambda raw: self.to_autopilot(raw, "daemon")
        self.signing = signing
        return signing

    def to_autopilot(self, raw: bytes, source: str = STATION) -> bool:
        """Send a frame. Returns whether it left."""
        for signed in self.signing.sign([read(raw)], source):
            self.sent.append(signed.raw)
            for answer in self.autopilot.receive(signed.raw):
                self.to_daemon(answer)
            return True
        return False

    def to_daemon(self, raw: bytes) -> list[Frame]:
        """What passes of a frame at the daemon."""
        self.recorded.append(raw)
        passed = self.signing.accept([read(raw)], self.now)
        self.passed += passed
        return passed

    def second(self) -> None:
        """The autopilot sends its HEARTBEAT, as each second."""
        self.now += 1.0
        self.to_daemon(self.autopilot.heartbeat())
