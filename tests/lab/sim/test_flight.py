"""The simulated autopilot on real sockets: its report, frames and links."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from tests.lab.sim.recorded import Collector, frames
from tests.lab.sim.station import decode, of_type
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.system.addresses import Address


def encode(message: Any) -> bytes:
    """A frame of a ground station's."""
    return bytes(message.pack(mavlink.MAVLink(None, 255, 190)))


HEARTBEAT = encode(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3))
ARM = encode(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))


async def test_the_report_has_the_frames_of_both_directions() -> None:
    async with Collector(EndpointKind.UDPIN, port := free_port()) as station:
        url = NetworkUrl(EndpointKind.UDPOUT, Address("127.0.0.1", port))
        async with Flight(url, AutopilotSettings(attitude_rate_hz=200)) as flight:
            await station.until(lambda: len(station.frames) >= 20)
            station.send(HEARTBEAT)
            station.send(ARM)
            await waiting.until(lambda: flight.autopilot.vehicle.armed)
            assert flight.report.frames_received == 2
        await station.until(lambda: len(station.frames) == flight.report.frames_sent)
        assert len(of_type(decode(station.frames), "COMMAND_ACK")) == 1


async def test_frames_pass_unchanged_in_both_directions() -> None:
    """What one end sends, the other collects byte for byte; a listener answers who called."""
    sent, answers = frames(20), frames(20, system_id=255)
    async with Collector(EndpointKind.UDPIN, port := free_port()) as ground:
        assert not ground.send(answers[0])
        async with Collector(EndpointKind.UDPOUT, port) as air:
            for frame in sent:
                assert air.send(frame)
            await ground.until(lambda: len(ground.frames) == len(sent))
            for frame in answers:
                assert ground.send(frame)
            await air.until(lambda: len(air.frames) == len(answers))
            assert (ground.frames, air.frames) == (sent, answers)
