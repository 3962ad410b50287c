"""The simulated autopilot on real sockets: reports, frames, and the end of a flight."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from tests.lab.sim.recorded import Collector
from tests.lab.sim.station import decode, of_type
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.links import LinkError


def encode(message: Any) -> bytes:
    """A frame of a ground station's."""
    return bytes(message.pack(mavlink.MAVLink(None, 255, 190)))


HEARTBEAT = encode(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3))
ARM = encode(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))


@pytest.mark.parametrize(("air", "ground"), [("udpout", "udpin"), ("tcp", "tcpin")])
async def test_callbacks_see_the_sent_frames(air: str, ground: str) -> None:
    """``on_sent`` gets each frame exactly as it arrives, and ``on_received`` each frame as it was sent."""
    sent: list[bytes] = []
    received: list[bytes] = []
    async with Collector(f"{ground}:127.0.0.1:0") as station:
        url = f"{air}:127.0.0.1:{station.address[1]}"
        async with Flight(
            url, AutopilotSettings(attitude_rate_hz=200), on_sent=sent.append, on_received=received.append
        ) as flight:
            await station.until(lambda: len(station.frames) >= 20)
            station.send(HEARTBEAT)
            station.send(ARM)
            await waiting.until(lambda: flight.autopilot.vehicle.armed)
            assert received == [HEARTBEAT, ARM]
            report = flight.report()
            assert (report.frames_sent, report.frames_received) == (len(sent), 2)
        await station.until(lambda: len(station.frames) == len(sent))
        assert station.frames == sent
        assert len(of_type(decode(station.frames), "COMMAND_ACK")) == 1


async def test_a_closed_connection_ends_the_flight() -> None:
    """The end of the TCP connection is the error."""
    async with Collector("tcpin:127.0.0.1:0") as station, Flight(f"tcp:127.0.0.1:{station.address[1]}") as flight:
        await station.until(lambda: bool(station.frames))
        await station.link.close()
        with pytest.raises(LinkError, match="closed the connection"):
            await flight.run()


async def test_a_fault_in_a_hook_ends_the_flight_where_it_is_awaited() -> None:
    """An exception out of ``on_sent`` is not lost in the event loop."""

    def broken(_frame: bytes) -> None:
        raise ZeroDivisionError

    async with Collector("udpin:127.0.0.1:0") as station:
        with pytest.raises(ZeroDivisionError):
            async with Flight(f"udpout:127.0.0.1:{station.address[1]}", on_sent=broken) as flight:
                await flight.run()
