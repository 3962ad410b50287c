"""A lost link is as if a wire were cut: nothing stale comes afterwards, nothing is invented, and failsafes see it."""

from __future__ import annotations

import asyncio
from collections import Counter
from time import monotonic
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import (
    GROUND_SYSTEM,
    Station,
    beat,
    command_long,
    drone_and_ground,
    ground_heartbeat,
    number_in,
    numbered,
    station,
)
from tests.daemon.harness import DaemonProcess, End, Relay, Sockaddr, Stage
from uavlinkd.lab.sim.flight import Flight

FAILSAFE_S = 5.0
"""The simulated autopilot's, and ArduPilot's, FS_GCS_TIMEOUT."""
BACK_WITHIN_S = 2.0
IN_FLIGHT_S = 0.05
"""A frame sent so shortly before the cut may have crossed, or not."""


async def block(relay: Relay, seconds: float) -> tuple[float, float]:
    """Let nothing through for so long; from when to when."""
    relay.on_datagram = lambda end, datagram: None
    began = monotonic()
    await asyncio.sleep(seconds)
    relay.on_datagram = relay.deliver
    return began, monotonic()


class Air:
    """A flight behind its daemon, a pilot behind the other, and every frame that each sent and heard."""

    def __init__(self, flight: Flight, pilot: Station, into: Sockaddr, sent: Counter[bytes]) -> None:
        self.flight = flight
        self.pilot = pilot
        self.into = into
        self.by_autopilot = sent
        self.by_pilot: Counter[bytes] = Counter()

    def say(self, frame: bytes) -> None:
        """Have the pilot's program send a frame."""
        self.by_pilot[frame] += 1
        self.pilot.send(frame, self.into)

    async def take_off(self) -> None:
        """Bring the copter up."""
        vehicle = self.flight.autopilot.vehicle
        for number, command in enumerate(
            (
                {"number": mavlink.MAV_CMD_DO_SET_MODE, "param1": 1, "param2": 4},
                {"number": mavlink.MAV_CMD_COMPONENT_ARM_DISARM, "param1": 1},
                {"number": mavlink.MAV_CMD_NAV_TAKEOFF, "param7": 3},
            )
        ):
            values = dict(command)
            self.say(command_long(int(values.pop("number")), GROUND_SYSTEM, seq=number, **values))
        await self.flight.until(lambda: vehicle.armed and vehicle.altitude_m > 1, 10)

    def check_nothing_invented(self, heard: Counter[bytes]) -> None:
        """All that came out at either end had gone in at the other, as often at least."""
        assert not Counter(self.pilot.frames) - self.by_autopilot
        assert not heard - self.by_pilot


@pytest.mark.parametrize(("outage_s", "trips"), [(3.0, False), (8.0, True)], ids=["3s", "8s"])
async def test_an_autopilot_sees_the_outage_as_long_as_it_is(stage: Stage, outage_s: float, trips: bool) -> None:
    """The failsafe for a lost station trips in an outage longer than its time, in no shorter; nothing is invented."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay)
    into_drone, into_ground = drone.add_endpoint("autopilot"), ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    sent: Counter[bytes] = Counter()
    heard: Counter[bytes] = Counter()
    events: list[tuple[float, str]] = []
    pilot = await station(stage)
    async with Flight(
        "udpout:{}:{}".format(*into_drone),
        on_sent=lambda frame: sent.update((frame,)),
        on_received=lambda frame: heard.update((frame,)),
        on_event=lambda name, facts: events.append((monotonic(), name)),
    ) as flight:
        air = Air(flight, pilot, into_ground, sent)
        beating = asyncio.create_task(beat(lambda number: air.say(ground_heartbeat(seq=number))))
        await flight.until(lambda: bool(flight.autopilot.stations))
        await pilot.until(lambda: bool(pilot.arrivals))
        await air.take_off()
        began, ended = await block(relay, outage_s)
        at_end, heard_at_end = len(pilot.arrivals), heard.total()
        await pilot.until(lambda: len(pilot.arrivals) > at_end, BACK_WITHIN_S)
        assert not [at for at, _ in pilot.arrivals if began + IN_FLIGHT_S < at < ended]
        await flight.until(lambda: heard.total() > heard_at_end, BACK_WITHIN_S + 1)
        failsafes = [at for at, name in events if name == "gcs_failsafe"]
        if trips:
            # The last heartbeat came up to a second before the cut.
            assert len(failsafes) == 1
            assert began + FAILSAFE_S - 1.5 < failsafes[0] < began + FAILSAFE_S + 1
            # The station is heard again: the outage's end is as visible as its beginning.
            await flight.until(lambda: [name for _, name in events].count("gcs_heard") == 2, BACK_WITHIN_S + 1)
            assert "peer_lost" in [each["event"] for each in drone.events()]
        else:
            await asyncio.sleep(max(0.0, began + FAILSAFE_S + 1.5 - monotonic()))
            assert failsafes == []
        beating.cancel()
    air.check_nothing_invented(heard)


@pytest.mark.parametrize(
    ("outage_s", "settings"),
    [(3.0, {}), (3.0, {"budget_bits_s": 100_000, "coalesce_s": 0.1}), (8.0, {"budget_bits_s": 20_000})],
    ids=["3s", "3s-coalescing", "8s-slow"],
)
async def test_nothing_sent_in_an_outage_comes_after_it(
    stage: Stage, outage_s: float, settings: dict[str, Any]
) -> None:
    """Numbered frames both ways: those of the outage never arrive, those after it do within two seconds, in order."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay, **settings)
    into_drone, into_ground = drone.add_endpoint("autopilot"), ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    autopilot, pilot = await station(stage), await station(stage)
    sent_at: list[float] = []

    def both(number: int) -> None:
        sent_at.append(monotonic())
        autopilot.send(numbered(number, 1), into_drone)
        pilot.send(command_long(400, GROUND_SYSTEM, (0, 0), seq=number, param1=number), into_ground)

    speaking = asyncio.create_task(beat(both, 0.05))
    for program in (autopilot, pilot):
        await program.until(lambda program=program: len(program.arrivals) > 10)  # type: ignore[misc]
    began, ended = await block(relay, outage_s)
    counts = len(autopilot.arrivals), len(pilot.arrivals)
    await asyncio.gather(
        pilot.until(lambda: len(pilot.arrivals) > counts[1] + 10, BACK_WITHIN_S + 1),
        autopilot.until(lambda: len(autopilot.arrivals) > counts[0] + 10, BACK_WITHIN_S + 1),
    )
    back_s = min(at for at, _ in pilot.arrivals if at > ended) - ended
    assert back_s < BACK_WITHIN_S
    speaking.cancel()

    # What waits for its turn on a slow radio may be a moment old, but never from before the link was back for long.
    waits_s = float(str(settings.get("coalesce_s", 0.0))) + (1.0 if settings.get("budget_bits_s") else 0.0)
    for program, number_of in ((pilot, number_in), (autopilot, number_in_command)):
        numbers = [number for frame in program.frames if (number := number_of(frame)) is not None]
        assert numbers == sorted(set(numbers)), "out of order, or twice"
        stale = [
            number for number in numbers if began + IN_FLIGHT_S < sent_at[number] < ended - waits_s - IN_FLIGHT_S
        ]
        assert not stale
        ages = [at - sent_at[number_of(frame) or 0] for at, frame in program.arrivals]
        assert sorted(ages)[int(0.95 * len(ages))] < waits_s + 0.2  # the rest: this machine has other work too
        assert max(ages) < waits_s + 1.0


def number_in_command(frame: bytes) -> int:
    """The number in the first parameter of a command."""
    message = mavlink.MAVLink(None).decode(bytearray(frame))
    return int(message.param1)


def lost(daemon: DaemonProcess) -> int:
    """How often it lost its peer."""
    return len(daemon.events("peer_lost"))


async def test_an_outage_of_one_way_is_as_visible(stage: Stage) -> None:
    """Where only what the ground says is lost, the autopilot hears nothing of it, and the drone is told so."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay, echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=0.5)
    into_drone, into_ground = drone.add_endpoint("autopilot"), ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    autopilot, pilot = await station(stage), await station(stage)

    def both(number: int) -> None:
        autopilot.send(numbered(number, 1), into_drone)
        pilot.send(ground_heartbeat(seq=number), into_ground)

    speaking = asyncio.create_task(beat(both, 0.05))
    for program in (autopilot, pilot):
        await program.until(lambda program=program: len(program.arrivals) > 10)  # type: ignore[misc]
    relay.on_datagram = lambda end, datagram: relay.deliver(end, datagram) if end is End.B else None
    await drone.until_logged("peer_lost")
    autopilot.clear()
    pilot.clear()
    await pilot.until(lambda: len(pilot.arrivals) > 20)
    assert autopilot.arrivals == []
    relay.on_datagram = relay.deliver
    await autopilot.until(lambda: len(autopilot.arrivals) > 10)
    speaking.cancel()
    assert lost(drone) == 1
