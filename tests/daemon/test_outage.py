"""A lost link is as if a wire were cut: nothing stale comes afterwards, nothing is invented, and failsafes see it."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence
from time import monotonic
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, beat, drone_and_ground, station
from tests.daemon.frames import GROUND_SYSTEM, command_long, ground_heartbeat, name_of, number_in, numbered
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.relay import Relay
from tests.daemon.udp import Sockaddr
from tests.kernel_queues import receive_queue
from tests.waiting import Stopwatch
from uavlinkd.core import constants as c
from uavlinkd.lab.sim.flight import Flight

FAILSAFE_S = 5.0
"""The simulated autopilot's, and ArduPilot's, FS_GCS_TIMEOUT."""
BACK_WITHIN_S = 6.0
"""tests/network shows 2 s by its own clock. Here the daemons share the machine with other work."""
VERIFIED_S = c.LATE_AFTER_S + c.HOLD_S
"""The specification's limit for the age of a frame that must be new."""
LOOKS_EVERY_S = 0.5
"""How often at least the simulated autopilot looks for the station's silence."""
IN_FLIGHT_S = 0.5
"""A frame sent so shortly before the cut may have crossed, or not."""


async def block(relay: Relay, seconds: float, *daemons: DaemonProcess) -> tuple[float, float]:
    """Let nothing through for so long.

    Returns:
        When the last frame from before the outage had arrived, and when the last frame was sent that was lost in it
        for certain: a daemon that a busy machine lets wait passes a frame on later.
    """
    relay.on_datagram = lambda end, datagram: None
    ends_at = monotonic() + seconds
    await _settle(daemons)
    began = monotonic()
    await asyncio.sleep(ends_at - monotonic())
    ended = monotonic()
    await _settle(daemons)
    relay.on_datagram = relay.deliver
    return began, ended


async def _settle(daemons: Sequence[DaemonProcess]) -> None:
    """Wait until the daemons have handled what waits in their sockets, and this process what they sent."""
    ports = [daemon.sockaddr[1] for daemon in daemons]
    ports += [int(daemon.config["endpoint"][0]["url"].rpartition(":")[2]) for daemon in daemons]
    seen: set[int] = set()
    while seen != set(ports):
        seen |= {port for port in ports if receive_queue(port).waiting_bytes == 0}
        await asyncio.sleep(0.001)
    for daemon in daemons:
        await daemon.status()
    await asyncio.sleep(0.1)  # this process reads its own sockets in the loop's next turns


class Air:
    """A flight behind its daemon, a pilot behind the other, and every frame that each sent and received."""

    def __init__(self, flight: Flight, pilot: Station, into: Sockaddr, sent: Counter[bytes]) -> None:
        self.flight = flight
        self.pilot = pilot
        self.into = into
        self.by_autopilot = sent
        self.by_pilot: Counter[bytes] = Counter()

    def say(self, frame: bytes) -> None:
        """Have the pilot's client send a frame."""
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
        await self.flight.until(lambda: vehicle.armed and vehicle.altitude_m > 1)

    def check_nothing_invented(self, received: Counter[bytes]) -> None:
        """All that came out at either end had gone in at the other, as often at least."""
        assert not Counter(self.pilot.frames) - self.by_autopilot
        assert not received - self.by_pilot


@pytest.mark.parametrize(
    ("outage_s", "trips"),
    [pytest.param(3.0, False, marks=pytest.mark.long, id="3s"), pytest.param(8.0, True, id="8s")],
)
async def test_an_autopilot_sees_the_outage_as_long_as_it_is(stage: Stage, outage_s: float, trips: bool) -> None:
    """The failsafe for a lost station trips in an outage longer than its time, in no shorter; nothing is invented."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay)
    into_drone, into_ground = drone.add_endpoint("autopilot"), ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    sent: Counter[bytes] = Counter()
    received: Counter[bytes] = Counter()
    events: list[tuple[float, str]] = []
    received_at: list[float] = []

    def on_received(frame: bytes) -> None:
        received.update((frame,))
        if name_of(frame) == "HEARTBEAT":
            received_at.append(monotonic())

    pilot = await station(stage)
    async with Flight(
        "udpout:{}:{}".format(*into_drone),
        on_sent=lambda frame: sent.update((frame,)),
        on_received=on_received,
        on_event=lambda name, facts: events.append((monotonic(), name)),
    ) as flight:
        air = Air(flight, pilot, into_ground, sent)
        beating = asyncio.create_task(beat(lambda number: air.say(ground_heartbeat(seq=number))))
        await flight.until(lambda: bool(flight.autopilot.stations))
        await pilot.until(lambda: bool(pilot.arrivals))
        await air.take_off()
        began, ended = await block(relay, outage_s, drone, ground)
        at_end, received_at_end, watch = len(pilot.arrivals), received.total(), Stopwatch()
        await pilot.until(lambda: len(pilot.arrivals) > at_end)
        await flight.until(lambda: received.total() > received_at_end)
        assert watch.calm_s < BACK_WITHIN_S
        assert not [at for at, _ in pilot.arrivals if began < at < ended]
        last_at = max(at for at in received_at if at <= began)
        silent_s = min(at for at in received_at if at > began) - last_at
        assert silent_s > outage_s - 1.5, "the last heartbeat came up to a second before the cut"
        # A busy machine makes it longer: what counts is what the autopilot saw.
        if trips or silent_s > FAILSAFE_S + LOOKS_EVERY_S:
            await flight.until(lambda: any(name == "gcs_failsafe" for _, name in events))
        failsafes = [at for at, name in events if name == "gcs_failsafe"]
        if silent_s < FAILSAFE_S:
            await asyncio.sleep(max(0.0, last_at + FAILSAFE_S + 1.5 - monotonic()))
            assert [at for at, name in events if name == "gcs_failsafe" and at < last_at + FAILSAFE_S + 1.5] == []
        elif trips:
            assert failsafes[0] > last_at + FAILSAFE_S - LOOKS_EVERY_S
            # The station is back: the outage's end is as visible as its beginning.
            await flight.until(lambda: [name for _, name in events].count("gcs_connected") >= 2)
            assert "peer_lost" in [event["event"] for event in drone.events()]
        beating.cancel()
    air.check_nothing_invented(received)


@pytest.mark.parametrize(
    ("outage_s", "settings"),
    [
        pytest.param(3.0, {}, id="3s"),
        pytest.param(3.0, {"budget_bits_s": 100_000, "coalesce_s": 0.1}, marks=pytest.mark.long, id="3s-coalescing"),
        pytest.param(8.0, {"budget_bits_s": 20_000}, marks=pytest.mark.long, id="8s-slow"),
    ],
)
async def test_nothing_sent_in_an_outage_comes_after_it(
    stage: Stage, outage_s: float, settings: dict[str, Any]
) -> None:
    """Numbered frames in both directions: those of the outage never arrive, those after it do soon, once each.

    The order is open: frames on the old session wait for proof that they are new, frames on a new session do not.
    """
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
    for client in (autopilot, pilot):
        await client.until(lambda client=client: len(client.arrivals) > 10)  # type: ignore[misc]
    began, ended = await block(relay, outage_s, drone, ground)
    watch = Stopwatch()
    counts = len(autopilot.arrivals), len(pilot.arrivals)
    await asyncio.gather(
        pilot.until(lambda: len(pilot.arrivals) > counts[1] + 10),
        autopilot.until(lambda: len(autopilot.arrivals) > counts[0] + 10),
    )
    assert watch.calm_s < BACK_WITHIN_S
    speaking.cancel()

    # What waits for its turn on a slow radio may be a moment old, but never from before the link was back for long.
    waits_s = float(str(settings.get("coalesce_s", 0.0))) + (1.0 if settings.get("budget_bits_s") else 0.0)
    for client, number_of in ((pilot, number_in), (autopilot, number_in_command)):
        numbers = [number for frame in client.frames if (number := number_of(frame)) is not None]
        assert len(numbers) == len(set(numbers)), "twice"
        stale = [number for number in numbers if began + IN_FLIGHT_S < sent_at[number] < ended - waits_s]
        assert not stale
        ages = [at - sent_at[number_of(frame) or 0] for at, frame in client.arrivals]
        assert max(ages) < waits_s + VERIFIED_S


def number_in_command(frame: bytes) -> int:
    """The number in the first parameter of a command."""
    message = mavlink.MAVLink(None).decode(bytearray(frame))
    return int(message.param1)
