"""RADIO_STATUS: for those who ask for it, and for nobody else."""

from __future__ import annotations

import asyncio
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, drone_and_ground, heartbeat, name_of, station
from tests.daemon.harness import End, Stage


def radio_states(program: Station) -> list[Any]:
    """Each RADIO_STATUS that came."""
    codec = mavlink.MAVLink(None)
    return [codec.decode(bytearray(frame)) for frame in program.frames if name_of(frame) == "RADIO_STATUS"]


async def test_only_the_endpoint_that_asks_is_told(stage: Stage) -> None:
    """One a second with figures of a good link where it is asked for; none at its neighbour or across the link."""
    drone, ground = drone_and_ground(stage)
    told, untold, pilot = await station(stage), await station(stage), await station(stage)
    drone.add_endpoint("told", f"udpout:{told}", radio_status=True)
    drone.add_endpoint("untold", f"udpout:{untold}")
    ground.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(drone, ground)
    await told.until(lambda: bool(radio_states(told)) and radio_states(told)[-1].rssi > 200)
    into = ("127.0.0.1", told.sources[-1][1])
    told.clear()
    began = asyncio.get_running_loop().time()
    await told.until(lambda: len(radio_states(told)) >= 4)
    took = asyncio.get_running_loop().time() - began
    assert took > 2.5
    for state in radio_states(told):
        assert (state.get_srcSystem(), state.get_srcComponent()) == (51, 68)
        assert state.rssi > 200
        assert state.remrssi > 200
        assert 90 < state.txbuf <= 100
        assert state.rxerrors == 0
    numbers = [state.get_seq() for state in radio_states(told)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    told.send(heartbeat(1), into)
    await asyncio.gather(untold.until_heard(heartbeat(1)), pilot.until_heard(heartbeat(1)))
    assert untold.frames == pilot.frames == [heartbeat(1)]


async def test_a_lost_peer_shows(stage: Stage) -> None:
    """Where the link is cut, the signal goes to nothing within the time after which a peer counts as lost."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay, echo_after_s=0.1, lost_after_s=0.5, handshake_after_s=0.3)
    told = await station(stage)
    drone.add_endpoint("told", f"udpout:{told}", radio_status=True)
    await stage.start(drone, ground)
    await told.until(lambda: bool(radio_states(told)) and radio_states(told)[-1].rssi > 200)
    relay.on_datagram = lambda end, datagram: None
    into = ("127.0.0.1", told.sources[-1][1])
    told.send(heartbeat(1), into)
    await told.until(lambda: radio_states(told)[-1].rssi == 0)
    assert radio_states(told)[-1].remrssi == 0
    assert radio_states(told)[-1].txbuf == 50
    relay.on_datagram = relay.deliver
    await told.until(lambda: radio_states(told)[-1].rssi > 200)


async def test_a_lossy_way_out_slows_the_autopilot(stage: Stage) -> None:
    """Where half of what is sent is lost, the figures say so, and the autopilot is told to send less."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay, probe_interval_s=0.5)
    told = await station(stage)
    drone.add_endpoint("told", f"udpout:{told}", radio_status=True)
    await stage.start(drone, ground)
    await told.until(lambda: bool(radio_states(told)))
    number = 0

    def lose_half(end: End, datagram: bytes) -> None:
        nonlocal number
        number += end is End.B
        if end is End.A or number % 2:
            relay.deliver(end, datagram)

    relay.on_datagram = lose_half

    async def speak() -> None:
        count = 0
        while True:
            count += 1
            told.send(heartbeat(1, seq=count), ("127.0.0.1", told.sources[-1][1]))
            await asyncio.sleep(0.02)

    speaking = asyncio.create_task(speak())
    await told.until(lambda: 60 < radio_states(told)[-1].remrssi < 200 and radio_states(told)[-1].txbuf < 25, 8)
    assert radio_states(told)[-1].rssi > 200
    speaking.cancel()
