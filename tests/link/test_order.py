"""What one system and component sends arrives in the order in which it was sent, along any paths.

pymavlink judges: it counts gaps in the sequence numbers, and rejects a signed frame whose timestamp does not grow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from tests.link.two_radios import Network, Radio
from tests.samples import read
from uavlinkd.mavlink.frames import Frame

SECRET = b"k" * 32
EVERY_S = 0.02
"""Between bursts of the autopilot."""
ENVELOPES_PER_BURST = 2
"""Or fewer. With an envelope for each class there were up to three, and copies."""


class Autopilot:
    """One system and component that numbers and signs its frames."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        signing = self._mav.signing
        signing.secret_key, signing.sign_outgoing, signing.timestamp = SECRET, True, 1_000_000
        self.sent: list[Frame] = []

    def burst(self, number: int) -> list[Frame]:
        """The frames of one wake-up during a log download: all classes, events and states."""
        messages: list[Any] = [mavlink.MAVLink_attitude_message(number, 1, 0, 0, 0, 0, 0)]
        log = [mavlink.MAVLink_log_data_message(1, 90 * number + part, 90, [1] * 90) for part in range(3)]
        messages += log[:2]
        if number % 5 == 0:
            messages.append(mavlink.MAVLink_command_ack_message(400, 0))
        messages.append(mavlink.MAVLink_vfr_hud_message(1, number, 1, 1, 1, 1))
        if number % 50 == 0:
            messages.append(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
        messages += log[2:]
        made = [self._pack(message) for message in messages]
        self.sent += made
        return made

    def _pack(self, message: Any) -> Frame:
        frame = read(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


class Station(mavutil.mavfile):  # type: ignore[misc]
    """A ground station that reads frames with pymavlink."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        super().__init__(None, "station", source_system=255, notimestamps=True, input=False)
        self.mav.signing.secret_key = SECRET
        self.rejected = 0
        """Frames whose signature has a timestamp that does not grow."""
        for frame in frames:
            for message in self.mav.parse_buffer(frame.raw):
                if message.get_type() == "BAD_DATA":
                    self.rejected += 1
                else:
                    self.post_message(message)


def fly(network: Network, seconds: float, then: Callable[[], None] = lambda: None) -> tuple[list[Frame], list[Frame]]:
    """A log download with telemetry; ``then`` happens in its middle. Returns what was sent and what was delivered."""
    autopilot, delivered = Autopilot(), network.alpha.delivered
    delivered.clear()
    network.bravo.sent.clear()
    network.at(network.now + seconds / 2, then)
    for number in range(round(seconds / EVERY_S)):
        network.bravo.send(*autopilot.burst(number))
        network.run(network.now + EVERY_S)
    network.run(network.now + 1)
    return autopilot.sent, delivered


NEAR, FAR = Radio(0.005), Radio(0.05)


@pytest.mark.parametrize(
    "radios",
    [
        pytest.param([NEAR], id="direct"),
        pytest.param([Radio(0.02, is_relayed=True)], id="relay"),
        pytest.param([NEAR, FAR], id="two paths"),
        pytest.param([FAR, Radio(0.02, is_relayed=True)], id="direct and relay"),
    ],
)
def test_each_frame_arrives_once_and_in_the_order_of_its_sender(radios: list[Radio]) -> None:
    """No gap in the numbers, and no signature is rejected."""
    network = Network(radios)
    network.establish()
    sent, delivered = fly(network, 6.0)
    assert delivered == sent
    station = Station(delivered)
    assert (station.packet_loss(), station.rejected) == (0, 0)
    assert len(network.bravo.sent) < ENVELOPES_PER_BURST * 6.0 / EVERY_S
