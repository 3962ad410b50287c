"""Scenarios in the air: a flight, outages with the autopilot's failsafe, restarts, two vehicles."""

from __future__ import annotations

import asyncio
import signal
from bisect import bisect_right
from itertools import pairwise
from time import monotonic

from tests.processes.frames import sender_of
from tests.processes.process import DaemonProcess
from tests.sitl.ledger import Passing, name_of
from tests.sitl.pilots import Mode, Pilot
from tests.sitl.tables import download_parameters
from tests.sitl.transfers import Figures, FlightError, counted, timed
from tests.sitl.world import Vehicle, World

OUTAGES_S = (2.0, 2.5, 3.0, 6.0, 20.0)
LEG_M = 30.0
APART_M = 10.0
"""The distance between two vehicles on the ground."""
RADIO_LOSS = 0.3
RETURN_S = 5.0
"""A radio that is back is used again within this time."""
BACK_S = 60.0
"""How long frames may take to pass again after an outage or a restart."""
BACK_WITHIN_S = 1.0
"""How long they may take once the network, or the only relay, is back."""


async def flight(world: World, pilot: Pilot) -> Figures:
    """Arm, take off, two guided waypoints, a mission of three waypoints, return and land."""
    await pilot.request_streams()

    async def act() -> Figures:
        began = monotonic()
        await pilot.take_off()
        start = pilot.place
        await pilot.go_to(start.moved(LEG_M, 0.0))
        await pilot.go_to(start.moved(LEG_M, LEG_M))
        guided_s = monotonic() - began
        await pilot.fly_mission(start.moved(0.0, LEG_M), start.moved(-LEG_M, 0.0), start)
        mission_s = monotonic() - began
        await pilot.return_and_land()
        return {
            "guided_s": round(guided_s, 1),
            "mission_s": round(mission_s - guided_s, 1),
            "return_s": round(monotonic() - began - mission_s, 1),
        }

    return await counted(world, act)


async def outages(world: World, pilot: Pilot) -> Figures:
    """Cut the network for 2 to 20 s in the air: the failsafe trips when it should, and control returns."""
    await pilot.request_streams()
    await pilot.set_parameters(pilot.kind.failsafe)
    await pilot.take_off()
    start = pilot.place
    results = []
    for number, seconds in enumerate(OUTAGES_S):
        await pilot.set_mode(Mode.GUIDED)
        await pilot.go_to(start.moved(LEG_M if number % 2 else 0.0, 0.0))
        with world.station.requesting(pilot.system):
            results.append(await _outage(world, pilot, seconds))
    await pilot.return_and_land()
    figures = {"outages": results}
    for outage in results:
        if problem := _problem_of(outage, pilot.kind.failsafe_s):
            raise FlightError(f"{outage['seconds']:g} s without network: {problem}", figures)
    return figures


async def _outage(world: World, pilot: Pilot, seconds: float) -> Figures:
    vehicle = world.vehicles[0]
    await world.cut()
    cut_at = monotonic()
    await asyncio.sleep(seconds)
    await world.restore()
    up_at = monotonic()
    down_back_s, up_back_s = await frames_pass_again(world, vehicle, up_at)
    await asyncio.sleep(2.0)  # a failsafe that trips late, or clears
    heartbeats = [at for at in beats_of_station(world, vehicle) if at < up_at]
    tripped_at = next(
        (at for at, mode in modes(vehicle) if at > cut_at and mode != pilot.kind.modes[Mode.GUIDED]), None
    )
    await pilot.set_mode(Mode.GUIDED)
    return {
        "seconds": seconds,
        "frames_back_s": down_back_s,
        "station_back_s": up_back_s,
        "failsafe": tripped_at is not None,
        "failsafe_after_s": None if tripped_at is None else round(tripped_at - heartbeats[-1], 1),
        "control_after_s": round(monotonic() - up_at, 1),
    }


def _problem_of(outage: Figures, failsafe_s: float) -> str:
    """Why an outage was not survived as promised; empty if it was."""
    if outage["failsafe"] != (outage["seconds"] > failsafe_s):
        return "the failsafe tripped" if outage["failsafe"] else "the failsafe did not trip"
    after_s, back_s = outage["failsafe_after_s"], max(outage["frames_back_s"], outage["station_back_s"])
    if after_s is not None and not failsafe_s - 0.5 <= after_s <= failsafe_s + 3.0:
        return f"the failsafe tripped after {after_s} s"
    return f"back after {back_s} s" if back_s > BACK_WITHIN_S else ""


async def two_radios(world: World, pilot: Pilot) -> Figures:
    """In the air, one of two radios dies and the other loses 30 %: the failsafe never trips, a mission is uploaded.

    Then the other radio dies, and the first one is back.
    """
    vehicle, (first, second) = world.vehicles[0], world.radios
    await pilot.request_streams()
    await pilot.set_parameters(pilot.kind.failsafe)
    await pilot.take_off()
    start = pilot.place
    await pilot.set_mode(Mode.GUIDED)
    began = monotonic()
    await first.cut()
    await second.lose(RADIO_LOSS)
    await pilot.fly_mission(start.moved(0.0, LEG_M), start.moved(LEG_M, LEG_M), start)
    mission_s = monotonic() - began
    await first.restore()
    await asyncio.sleep(RETURN_S)
    await second.cut()
    await pilot.set_mode(Mode.GUIDED)
    await pilot.go_to(start.moved(LEG_M, 0.0))
    beats = [began, *(at for at in beats_of_station(world, vehicle) if at > began), monotonic()]
    silence_s = max(later - earlier for earlier, later in pairwise(beats))
    flown = {pilot.kind.modes[mode] for mode in (Mode.GUIDED, Mode.MISSION)}
    others = sorted({mode for at, mode in modes(vehicle) if at > began} - flown)
    await second.restore()
    await pilot.return_and_land()
    figures: Figures = {
        "mission_s": round(mission_s, 1),
        "heartbeats": len(beats) - 2,
        "longest_silence_s": round(silence_s, 2),
        "other_modes": others,
    }
    if others:
        raise FlightError(f"the autopilot left its mode: {others}", figures)
    return figures


async def frames_pass_again(world: World, vehicle: Vehicle, since: float) -> tuple[float, float]:
    """Wait until frames pass in both directions; the seconds from ``since`` to the first frame of each."""

    def first(passings: list[Passing], system: int) -> float | None:
        newest = passings[bisect_right(passings, since, key=lambda passing: passing.at) :]
        return next((passing.at for passing in newest if sender_of(passing.frame) == system), None)

    def down() -> float | None:
        return first(world.station.received, vehicle.system)

    def up() -> float | None:
        return first(vehicle.tap.to_autopilot, world.station.system)

    async with asyncio.timeout(BACK_S):
        while down() is None or up() is None:  # noqa: ASYNC110  two ends have to be asked
            await asyncio.sleep(0.02)
    return round((down() or 0.0) - since, 2), round((up() or 0.0) - since, 2)


def modes(vehicle: Vehicle) -> list[tuple[float, int]]:
    """When the autopilot reported which mode, at its own end of the link."""
    result = []
    for passing in vehicle.tap.from_autopilot:
        frame = passing.frame
        if name_of(frame) == "HEARTBEAT" and frame[0] == 0xFD and frame[6] == 1:
            result.append((passing.at, int.from_bytes(frame[10:14], "little")))
    return result


def beats_of_station(world: World, vehicle: Vehicle) -> list[float]:
    """When heartbeats of the station reached the autopilot."""
    return [
        passing.at
        for passing in vehicle.tap.to_autopilot
        if name_of(passing.frame) == "HEARTBEAT" and sender_of(passing.frame) == world.station.system
    ]


async def restarts(world: World, pilot: Pilot) -> Figures:
    """In the air, restart and kill both daemons; on the ground, kill the simulator: it has a new source port then.

    The ground station's failsafe is on. It must not trip: a daemon is back before.
    """
    vehicle = world.vehicles[0]
    await pilot.request_streams()
    results: list[Figures] = []
    await pilot.set_parameters(pilot.kind.failsafe)
    await pilot.take_off()
    start = pilot.place
    await pilot.set_mode(Mode.GUIDED)
    assert world.ground is not None
    assert vehicle.daemon is not None
    cases: list[tuple[str, DaemonProcess, signal.Signals]] = [
        ("drone's daemon restarted", vehicle.daemon, signal.SIGTERM),
        ("drone's daemon killed", vehicle.daemon, signal.SIGKILL),
        ("ground's daemon restarted", world.ground, signal.SIGTERM),
        ("ground's daemon killed", world.ground, signal.SIGKILL),
    ]
    for number, (what, daemon, how) in enumerate(cases):
        began = monotonic()
        await daemon.stop(how)
        await daemon.start()
        down_s, up_s = await frames_pass_again(world, vehicle, monotonic())
        absent_s = round(monotonic() - began, 2)
        await pilot.go_to(start.moved(LEG_M / 2 if number % 2 == 0 else 0.0, 0.0))
        tripped = any(mode != pilot.kind.modes[Mode.GUIDED] for at, mode in modes(vehicle) if at > began)
        assert not tripped, f"the failsafe tripped: {what}"
        results.append({"what": what, "absent_s": absent_s, "down_back_s": down_s, "up_back_s": up_s})
    await pilot.return_and_land()
    results.append(await _restart_simulator(world, pilot, vehicle))
    return {"restarts": results}


async def _restart_simulator(world: World, pilot: Pilot, vehicle: Vehicle) -> Figures:
    before = vehicle.tap.sources
    await vehicle.simulator.stop(signal.SIGKILL)
    world.station.latest.clear()
    began = monotonic()
    await vehicle.simulator.start(vehicle.tap.address)
    newest = vehicle.tap.from_autopilot[-1]
    await world.station.until(
        lambda: vehicle.tap.sources > before and vehicle.tap.from_autopilot[-1] is not newest,
        BACK_S,
        "a frame from a new source port",
    )
    first_at = vehicle.tap.from_autopilot[-1].at
    down_s, up_s = await frames_pass_again(world, vehicle, first_at)
    await pilot.request_streams()
    seconds, parameters = await timed(download_parameters(world.station, pilot.system))
    return {
        "what": "simulator killed",
        "new_source_port": vehicle.tap.sources > before,
        "boot_s": round(first_at - began, 2),
        "down_back_s": down_s,
        "up_back_s": up_s,
        "parameters": len(parameters),
        "parameters_s": seconds,
    }


async def two_vehicles(world: World, pilots: list[Pilot]) -> Figures:
    """One station flies two vehicles at once; each gets its own commands only."""
    for pilot in pilots:
        await pilot.request_streams()

    async def act() -> Figures:
        downloads = [timed(download_parameters(world.station, pilot.system)) for pilot in pilots]
        tables = await asyncio.gather(*downloads)
        await asyncio.gather(*(pilot.take_off() for pilot in pilots))
        starts = [pilot.place for pilot in pilots]
        await pilots[0].go_to(starts[0].moved(LEG_M, 0.0))
        stayed_m = pilots[1].place.distance_m(starts[1])
        assert stayed_m < APART_M / 2, "the other vehicle moved too"
        await pilots[1].go_to(starts[1].moved(-LEG_M, 0.0))
        await asyncio.gather(*(pilot.return_and_land() for pilot in pilots))
        return {"parameters": [len(table) for _, table in tables], "parameters_s": [seconds for seconds, _ in tables]}

    figures = await counted(world, act)
    for vehicle in world.vehicles:
        foreign = [p for p in world.station.sent if p.target not in (0, vehicle.system)]
        arrived = {p.frame for p in vehicle.tap.to_autopilot}
        assert not any(p.frame in arrived for p in foreign), "a command reached the other vehicle"
    return figures
