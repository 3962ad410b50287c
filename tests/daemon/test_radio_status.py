"""RADIO_STATUS: for endpoints that request it, and for no other."""

from __future__ import annotations

import asyncio
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, drone_and_ground, station
from tests.daemon.frames import heartbeat, name_of
from tests.daemon.harness import Stage


def radio_states(client: Station) -> list[Any]:
    """Each RADIO_STATUS that came."""
    codec = mavlink.MAVLink(None)
    return [codec.decode(bytearray(frame)) for frame in client.frames if name_of(frame) == "RADIO_STATUS"]


async def test_only_the_configured_endpoint_gets_it(stage: Stage) -> None:
    """One a second with figures of a good link where it is asked for; none at its neighbour or across the link."""
    drone, ground = drone_and_ground(stage)
    reported, untold, pilot = await station(stage), await station(stage), await station(stage)
    drone.add_endpoint("radio", f"udpout:{reported}", radio_status=True)
    drone.add_endpoint("untold", f"udpout:{untold}")
    ground.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(drone, ground)
    await reported.until(lambda: bool(radio_states(reported)) and radio_states(reported)[-1].rssi > 200)
    into = ("127.0.0.1", reported.sources[-1][1])
    reported.clear()
    began = asyncio.get_running_loop().time()
    await reported.until(lambda: len(radio_states(reported)) >= 4)
    took = asyncio.get_running_loop().time() - began
    assert took > 2.5
    for state in radio_states(reported):
        assert (state.get_srcSystem(), state.get_srcComponent()) == (51, 68)
        assert state.rssi > 200
        assert state.remrssi > 200
        assert 90 < state.txbuf <= 100
        assert state.rxerrors == 0
    numbers = [state.get_seq() for state in radio_states(reported)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    reported.send(heartbeat(1), into)
    await asyncio.gather(untold.until_received(heartbeat(1)), pilot.until_received(heartbeat(1)))
    assert untold.frames == pilot.frames == [heartbeat(1)]
