"""``uavlinkd demo``: two real daemons on loopback, each with an autopilot; every frame is checked."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path

from rich.console import Console
from rich.live import Live

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.demo_attacks import ATTACKED_LINK, AttackCourse
from uavlinkd.lab.sim.demo_results import Drone, FrameCounts, Summary
from uavlinkd.lab.sim.demo_screen import render, render_summary
from uavlinkd.lab.sim.drone_process import DroneError
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.ops.link_problems import LinkProblem

DemoError = DroneError
"""The demo failed. The message is for the operator."""

LINK_UP_S = 120.0
"""How long the daemons may take to start and link. They need about half a second."""
DRAIN_S = 15.0
"""How long the last frames may take to arrive."""
ATTITUDE_HZ = 50.0
REKEY_AFTER_S = 4.0
"""The rekey interval, instead of two minutes, so that the demo shows some rekeys."""
SCREEN_S = 0.25
SECONDS = 15.0
ATTACK_SECONDS = 3.0
ATTACKED_SHARE = 2 / 3
"""Share of each attack's time in which it is active. In the rest the link recovers."""
RECOVERY_S = 2.0
"""Within this time after the last attack, frames must be delivered again."""


async def run_demo(
    seconds: float | None = None, *, show: bool, attack: str | None = None, console: Console | None = None
) -> Summary:
    """Run the demo, on a live screen if ``show``.

    Args:
        seconds: of traffic; by default :data:`SECONDS`, or with attacks :data:`ATTACK_SECONDS` for each.
        attack: an attack between the drones, as for ``uavlink-mitm``, or ``all``.

    Raises:
        DemoError: the daemons do not start or do not link.
        AttackError: there is no such attack, or it needs more than two drones.
    """
    console = console or Console()
    course = None if attack is None else AttackCourse(attack)
    if seconds is None:
        seconds = SECONDS if course is None else ATTACK_SECONDS * len(course.specs)
    try:
        summary = await _run(seconds, console if show else None, course)
    except asyncio.CancelledError:
        if show:
            console.print("Interrupted. The daemons have stopped, and their keys are deleted.")
        raise
    if show:
        console.print(render_summary(summary))
    return summary


async def _run(seconds: float, console: Console | None, course: AttackCourse | None) -> Summary:
    with private_folder("uavlinkd-demo-") as folder:
        drones = await _make_drones(folder, course)
        try:
            for drone in drones:
                await drone.start()
            return await _fly(drones, seconds, console, course)
        finally:
            for drone in drones:
                await drone.stop()
            if course is not None:
                await course.leave()


@contextmanager
def _screen(console: Console) -> Iterator[Live]:
    """The live screen. The summary replaces it; after Ctrl-C it remains."""
    with Live(console=console, auto_refresh=False, transient=True) as live:
        try:
            yield live
        except asyncio.CancelledError:
            live.transient = False
            raise


async def _make_drones(folder: Path, course: AttackCourse | None) -> tuple[Drone, Drone]:
    ports = free_ports(4)
    first = Drone("drone0", folder / "drone0", ports[0], ports[1])
    second = Drone("drone1", folder / "drone1", ports[2], ports[3])
    psk = generate_psk()
    at = {first.name: first.port, second.name: second.port}
    link: dict[str, object] = {"rekey_after_s": REKEY_AFTER_S, "probe_interval_s": 1.0}
    if course is not None:
        keys = {drone.name: decode_key(drone.public_key) for drone in (first, second)}
        at = await course.stand_between(at, keys)
        link |= ATTACKED_LINK
    for drone, peer in ((first, second), (second, first)):
        drone.share_psk(psk, "pair.psk")
        drone.configure(link, [peer.as_peer(f"127.0.0.1:{at[peer.name]}", "pair.psk")])
    return first, second


async def _fly(
    drones: tuple[Drone, Drone], seconds: float, console: Console | None, course: AttackCourse | None
) -> Summary:
    there, back = FrameCounts(), FrameCounts()
    loop = asyncio.get_running_loop()
    async with AsyncExitStack() as stack:
        for drone, out, into, system_id in ((drones[0], there, back, 1), (drones[1], back, there, 2)):
            settings = AutopilotSettings(system_id=system_id, attitude_rate_hz=ATTITUDE_HZ)
            flight = Flight(drone.endpoint_url, settings, on_sent=out.on_sent, on_received=into.on_received)
            await stack.enter_async_context(flight)
        live = stack.enter_context(_screen(console)) if console else None

        async def until(done_at: float, is_done: Callable[[], bool]) -> bool:
            while loop.time() < done_at:
                for drone in drones:
                    await drone.ask()
                if course is not None:
                    course.look(noticed_by(drones))
                if live is not None:
                    live.update(render(drones, (there, back), done_at - loop.time(), course), refresh=True)
                if is_done():
                    return True
                await asyncio.sleep(min(SCREEN_S, max(0.0, done_at - loop.time())))
            return is_done()

        if not await until(loop.time() + LINK_UP_S, lambda: all(drone.is_ready() for drone in drones)):
            lines = "\n".join(line for drone in drones for line in drone.last_lines(5))
            raise DemoError(f"the two daemons did not link within {LINK_UP_S:g} s; their last log lines:\n{lines}")
        started_at = loop.time()
        for drone in drones:
            drone.begin()
        there.counting = back.counting = True
        if course is None:
            await until(started_at + seconds, lambda: False)
        else:
            share_s = seconds / len(course.specs)
            for number in range(len(course.specs)):
                begin_at = loop.time()
                course.begin(number, noticed_by(drones))
                await until(begin_at + ATTACKED_SHARE * share_s, lambda: False)
                more_s = course.end()
                await until(begin_at + share_s + more_s, lambda: False)
                course.finish()
        there.counting = back.counting = False
        elapsed = loop.time() - started_at
        if course is None:
            await until(loop.time() + DRAIN_S, lambda: there.outstanding == back.outstanding == 0)
        else:
            # Dropped frames do not arrive. Wait until the link carries frames again.
            there_before, back_before = there.arrived, back.arrived
            course.is_recovered = await until(
                loop.time() + RECOVERY_S, lambda: there.arrived > there_before and back.arrived > back_before
            )
    return _summary(drones, (there, back), elapsed, course)


def noticed_by(drones: tuple[Drone, Drone]) -> Counter[str]:
    """The counters of dropped datagrams and of link problems, of both drones."""
    noticed = drops_of(drones)
    for drone in drones:
        noticed.update({sign: drone.peer_status.get(sign, 0) for sign in LinkProblem})
    return noticed


def drops_of(drones: tuple[Drone, Drone]) -> Counter[str]:
    """The counters of dropped datagrams of both daemons, by reason."""
    drops: Counter[str] = Counter()
    for drone in drones:
        drops.update(drone.status.get("drops", {}))
        drops.update(drone.peer_status.get("drops", {}))
    return drops


def _summary(
    drones: tuple[Drone, Drone],
    directions: tuple[FrameCounts, FrameCounts],
    seconds: float,
    course: AttackCourse | None,
) -> Summary:
    drops = sum((drone.drops for drone in drones), Counter[str]())
    round_trips = [s for drone in drones if (s := drone.peer_status["round_trip_s"]) is not None]
    return Summary(
        seconds=round(seconds, 3),
        frames_sent=sum(counts.sent for counts in directions),
        frames_delivered=sum(counts.delivered for counts in directions),
        frames_altered=sum(counts.altered for counts in directions),
        handshakes=drones[0].peer_status["handshakes"],
        drops=dict(drops),
        rtt_ms=round(1000 * min(round_trips), 3) if round_trips else None,
        attacks=None if course is None else course.results(),
        is_recovered=course is None or course.is_recovered,
    )
