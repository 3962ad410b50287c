"""A key that changes at each disarm, under traffic, and what interrupts it."""

from __future__ import annotations

from random import Random

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.conftest import EXAMPLES
from tests.mavlink.parsers.receivers import compiler
from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.c_library import CAutopilot
from tests.mavlink.signing.wire import KEY, Wire, keyed
from tests.samples import pack
from uavlinkd.config.model import LINK_ID
from uavlinkd.daemon.signing import REPEAT_S
from uavlinkd.mavlink.signing.signature import Signer
from uavlinkd.protocol.crypto import Secret

STEP_S = 0.02
"""Between two frames in each direction. A HEARTBEAT comes each second."""
MOST_GAP_S = 1.0
INTERRUPTIONS = (
    "none",
    "the daemon is killed before SETUP_SIGNING",
    "the daemon is killed after SETUP_SIGNING",
    "SETUP_SIGNING is lost",
    "the answer is lost",
    "the autopilot restarts before the answer",
    "the autopilot restarts, and the daemon is killed",
)


class Rotations:
    """Traffic in both directions, and changes of the key as the daemon and the command make them."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.wire = Wire(autopilot)
        self.longest_gap_s = 0.0
        self._key = KEY
        self._last = [0.0, 0.0]  # when a frame passed, up and down
        self._command = pack(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 2, 0, 0, 0, 0, 0), 255, 190)
        self._steps = 0

    def traffic(self, seconds: float) -> None:
        wire = self.wire
        for _ in range(round(seconds / STEP_S)):
            wire.now += STEP_S
            self._steps += 1
            if self._steps % 50 == 0:
                wire.to_daemon(wire.autopilot.heartbeat())
            arrived = len(wire.autopilot.accepted)
            wire.to_autopilot(self._command)
            passed = wire.to_daemon(wire.autopilot.send(mavlink.MAVLink_attitude_message(1, 2, 3, 4, 5, 6, 7)))
            for way, has_passed in enumerate((len(wire.autopilot.accepted) > arrived, bool(passed))):
                if has_passed:
                    self.longest_gap_s = max(self.longest_gap_s, wire.now - self._last[way])
                    self._last[way] = wire.now
            del wire.autopilot.accepted[:], wire.recorded[:], wire.sent[:], wire.passed[:]

    def rotate(self, new: Secret, interruption: str) -> None:
        """One change, repeated as the command is until both ends have the new key."""
        wire = self.wire
        self._attempt(new, interruption)
        while not (wire.signing.is_proven and wire.signing.signer.secret == new):
            self._attempt(new, "none")
        old, self._key = self._key, new
        assert wire.autopilot.key == new.reveal()
        forged = Signer(old)
        assert not wire.to_daemon(forged.sign(pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)), 3, 2**47))
        assert interruption != "none" or not wire.autopilot.rejected
        wire.autopilot.rejected.clear()  # those that were signed with the old key when an answer was lost
        wire.autopilot.receive(forged.sign(self._command, LINK_ID, 2**47))
        assert wire.autopilot.rejected.total() == 1
        wire.autopilot.rejected.clear()

    def _attempt(self, new: Secret, interruption: str) -> None:
        wire, autopilot = self.wire, self.wire.autopilot
        if interruption == "the daemon is killed before SETUP_SIGNING":
            wire.daemon_starts(self._key)
        else:
            newest = wire.signing.add(new)
            autopilot.is_deaf = interruption == "SETUP_SIGNING is lost"
            wire.signing.set_up(new, 1)
            autopilot.is_deaf = interruption in ("SETUP_SIGNING is lost", "the answer is lost")
            if "restarts" in interruption:
                autopilot.restart()
            if "after" in interruption or "and the daemon is killed" in interruption:
                wire.daemon_starts(self._key)
            else:
                wire.signing.ask(newest, wire.now)
            autopilot.is_deaf = False
        self.traffic(REPEAT_S)


@pytest.mark.skipif(compiler() is None, reason="needs a C compiler (cc) to build MAVLink's parsers")
@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_rotations(kind: str) -> None:
    """The two ends agree again by themselves, frames pause for less than a second, the old key is void."""
    autopilot = keyed(CAutopilot(kind))
    rotations, random = Rotations(autopilot), Random(EXAMPLES)
    rotations.traffic(2.0)
    for number in range(2 * EXAMPLES):
        autopilot.is_armed = True
        rotations.traffic(0.5)
        autopilot.is_armed = False
        autopilot.save()
        rotations.rotate(Secret((number + 7).to_bytes(4, "little") * 8), random.choice(INTERRUPTIONS))
        rotations.traffic(0.5)
        assert not autopilot.rejected
    print(f"{kind}: {2 * EXAMPLES} rotations, {rotations.longest_gap_s:.2f} s")
    assert rotations.longest_gap_s < MOST_GAP_S
