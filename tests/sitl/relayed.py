"""Flights through relays: the ordinary one, then one in which relays are killed in the air."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import monotonic

from tests.processes.frames import sender_of
from tests.processes.process import DaemonProcess
from tests.sitl.flights import BACK_WITHIN_S, LEG_M, flight, frames_pass_again, modes
from tests.sitl.ledger import SETTLED_S, Comparison, Passing, compare, compare_by, number_of, of_class
from tests.sitl.pilots import Mode, Pilot
from tests.sitl.transfers import Figures, FlightError, parameters_and_mission
from tests.sitl.world import GROUND, World
from uavlinkd.protocol.settings import Class

KILLS = 3
CALM_S = 3.0
"""Frames pass for so long before a relay is killed, and after a link is back."""
STREAM_GAP_S = 0.5
"""With two relays."""


async def relayed(world: World, pilot: Pilot) -> Figures:
    """The ordinary flight; then the only relay is killed and started in the air, or one of two is killed for good."""
    figures: Figures = {"relays": len(world.relays), "tables": await parameters_and_mission(world, pilot)}
    figures |= await flight(world, pilot)
    await pilot.set_parameters(pilot.kind.failsafe)
    await pilot.take_off()
    with world.station.requesting(pilot.system):
        killed = _one_of_two_killed if len(world.relays) > 1 else _killed_and_started
        figures["kills"] = [kill async for kill in killed(world, pilot)]
    await pilot.return_and_land()
    for kill in figures["kills"]:
        if problem := problem_of(kill):
            raise FlightError(f"{kill['what']}: {problem}", figures)
    return figures


async def _killed_and_started(world: World, pilot: Pilot) -> AsyncIterator[Figures]:
    (relay,), start = world.relays, pilot.place
    for number in range(KILLS):
        assert await _carrying(world) is relay
        began = await _kill(relay)
        await relay.start()
        await relay.ready()
        listens = monotonic()
        down_s, up_s = await frames_pass_again(world, world.vehicles[0], listens)
        await pilot.go_to(start.moved(LEG_M / 2 if number % 2 == 0 else 0.0, 0.0))
        yield {
            "what": "the only relay, started again",
            "absent_s": round(listens - began, 2),
            "down_back_s": down_s,
            "up_back_s": up_s,
            **await _judged(world, pilot, began),
        }


async def _one_of_two_killed(world: World, pilot: Pilot) -> AsyncIterator[Figures]:
    start = pilot.place
    began = await _kill(await _carrying(world))
    await pilot.fly_mission(start.moved(0.0, LEG_M), start.moved(LEG_M, LEG_M), start)
    yield {"what": "one of two, for good", **await _judged(world, pilot, began)}


async def _kill(relay: DaemonProcess) -> float:
    """End a relay as a power failure would, after a calm time; the moment."""
    await asyncio.sleep(CALM_S)
    began = monotonic()
    await relay.kill()
    return began


async def _carrying(world: World) -> DaemonProcess:
    """The relay that carries the vehicle's telemetry."""
    daemon = world.vehicles[0].daemon
    assert daemon is not None
    paths = (await daemon.status())["peers"][GROUND]["paths"]
    (name,) = (path["relay"] for path in paths if "stream" in path["carries"])
    return next(relay for relay in world.relays if relay.name == name)  # no direct path


# What a kill did to frames.


@dataclass(frozen=True, slots=True)
class Way:
    """One direction: what went in, and what came out."""

    sent: Sequence[Passing]
    received: Sequence[Passing]

    def only(self, cls: Class) -> Way:
        """The frames of one class."""
        return Way(of_class(self.sent, cls), of_class(self.received, cls))

    def longest_gap_s(self, begin: float, end: float) -> float:
        """The longest time without a frame that came out."""
        arrivals = [passing.at for passing in self.received if begin < passing.at < end]
        return max(later - earlier for earlier, later in pairwise([begin, *arrivals, end]))


async def _judged(world: World, pilot: Pilot, began: float) -> Figures:
    """The figures of the time since ``began``, and of a calm time after now."""
    await asyncio.sleep(CALM_S)
    end = monotonic()
    await asyncio.sleep(2 * SETTLED_S)
    down, up = ways(world)
    # In a thread: it takes seconds, in which a station without heartbeats would cause the failsafe itself.
    whole, critical = await asyncio.to_thread(_compared, (down, up), began, end)
    flown = [mode for at, mode in modes(world.vehicles[0]) if at > began]
    return {
        "sent": whole.sent,
        "lost": whole.missing.total(),
        "altered": whole.foreign.total(),
        "duplicated": whole.duplicated,
        "reordered": whole.reordered,
        "critical_sent": critical.sent,
        "critical_lost": critical.missing.total(),
        "stream_gap_s": round(down.only(Class.STREAM).longest_gap_s(began, end), 2),
        "down_gap_s": round(down.only(Class.CRITICAL).longest_gap_s(began, end), 2),
        "up_gap_s": round(up.longest_gap_s(began, end), 2),
        "failsafe": pilot.kind.modes[Mode.RETURN] in flown,
    }


def _compared(both: tuple[Way, Way], began: float, end: float) -> tuple[Comparison, Comparison]:
    """All frames, and the critical ones, in both directions."""
    whole, critical = Comparison(), Comparison()
    for way in both:
        whole.add(compare_by(number_of, way.sent, way.received, began, end))
        critical.add(compare(way.only(Class.CRITICAL).sent, way.only(Class.CRITICAL).received, began, end))
    return whole, critical


def ways(world: World) -> tuple[Way, Way]:
    """Down from the vehicle, and up to it, until now."""
    (vehicle,), station = world.vehicles, world.station
    return (
        Way([*vehicle.tap.from_autopilot], [p for p in station.received if sender_of(p.frame) == vehicle.system]),
        Way([*station.sent], [p for p in vehicle.tap.to_autopilot if sender_of(p.frame) == station.system]),
    )


def problem_of(kill: Figures) -> str:
    """Why a kill was not survived as promised; empty if it was."""
    if kill["failsafe"]:
        return "the failsafe tripped"
    for fault in ("altered", "duplicated", "reordered"):
        if kill[fault]:
            return f"{kill[fault]} frames {fault}"
    if "down_back_s" in kill:
        back_s = max(kill["down_back_s"], kill["up_back_s"])
        return f"back after {back_s} s" if back_s > BACK_WITHIN_S else ""
    if kill["critical_lost"]:
        return f"{kill['critical_lost']} critical frames lost"
    return f"{kill['stream_gap_s']} s without telemetry" if kill["stream_gap_s"] > STREAM_GAP_S else ""
