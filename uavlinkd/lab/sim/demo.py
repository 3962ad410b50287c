"""``uavlinkd demo``: two real daemons on loopback, an autopilot at each, and every frame accounted for."""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.ops.log import DISTURBANCES
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.demo_attacks import ATTACKED_LINK, AttackCourse, AttackResult
from uavlinkd.lab.sim.demo_screen import render, render_summary
from uavlinkd.lab.sim.drone_process import DroneError, DroneProcess, free_udp_ports
from uavlinkd.lab.sim.flight import Flight

DemoError = DroneError
"""The demo could not be shown. The message is for a person."""

LINK_UP_S = 30.0
"""How long the daemons may take to start and link. They take about half a second."""
DRAIN_S = 15.0
"""How long the last frames may be on their way."""
ATTITUDE_HZ = 50.0
REKEY_AFTER_S = 4.0
"""New keys this often, instead of each two minutes, so that there is something to see."""
SCREEN_S = 0.25
SECONDS = 15.0
ATTACK_SECONDS = 3.0
ATTACKED_SHARE = 2 / 3
"""Of the time of an attack; the rest shows that the link is as before."""
RECOVERY_S = 2.0
"""After the last attack frames must come out within this."""


@dataclass(slots=True)
class Direction:
    """Frames of one autopilot on their way to the other, counted as they are: byte for byte."""

    sent: int = 0
    delivered: int = 0
    arrived: int = 0
    """Delivered, and those outside the measured time."""
    altered: int = 0
    counting: bool = False
    _waiting: Counter[bytes] = field(default_factory=Counter)
    _uncounted: Counter[bytes] = field(default_factory=Counter)

    @property
    def outstanding(self) -> int:
        """Sent and not yet delivered."""
        return self.sent - self.delivered

    def on_sent(self, frame: bytes) -> None:
        """A frame left the autopilot. Before and after the measured time it may be lost, and is not counted."""
        if self.counting:
            self.sent += 1
            self._waiting[frame] += 1
        else:
            self._uncounted[frame] += 1

    def on_received(self, frame: bytes) -> None:
        """A frame reached the other autopilot."""
        if self._waiting[frame] > 0:
            self._waiting[frame] -= 1
            self.delivered += 1
            self.arrived += 1
        elif self._uncounted[frame] > 0:
            self._uncounted[frame] -= 1
            self.arrived += 1
        else:
            self.altered += 1


@dataclass(frozen=True, slots=True)
class Summary:
    """What the demo came to."""

    seconds: float
    frames_sent: int
    frames_delivered: int
    frames_altered: int
    handshakes: int
    drops: dict[str, int]
    rtt_ms: float | None
    attacks: list[AttackResult] | None = None
    """What was done to the link; None for a demo without attacks."""
    is_recovered: bool = True
    """Whether frames came out both ways after the last attack."""

    @property
    def is_perfect(self) -> bool:
        """Whether every frame arrived unaltered, and there were any."""
        return self.frames_sent > 0 and self.frames_delivered == self.frames_sent and self.frames_altered == 0

    @property
    def is_good(self) -> bool:
        """Perfect; or under attack: nothing false came out, each attack was made, and the link lives.

        An attacker can always drop frames, so that some are missing then is no fault.
        """
        if self.attacks is None:
            return self.is_perfect
        is_real = all(attack.interventions > 0 for attack in self.attacks)
        return self.frames_delivered > 0 and self.frames_altered == 0 and is_real and self.is_recovered

    def to_json(self) -> str:
        """One line."""
        facts = asdict(self)
        if self.attacks is None:
            del facts["attacks"], facts["is_recovered"]
        return json.dumps(facts)


class Drone(DroneProcess):
    """One of the two drones of the demo."""

    @property
    def endpoint_url(self) -> str:
        """Where its autopilot sends to."""
        return f"udpout:127.0.0.1:{self.endpoint_port}"

    @property
    def peer_status(self) -> dict[str, Any]:
        """What it says of its only peer; empty before it has answered."""
        return next(iter(self.peer_statuses), {})


async def run_demo(
    seconds: float | None = None, *, show: bool, attack: str | None = None, console: Console | None = None
) -> Summary:
    """Run it for so many seconds of traffic, on a live screen if ``show``.

    Args:
        seconds: by default :data:`SECONDS`, or with attacks :data:`ATTACK_SECONDS` for each.
        attack: stand between the drones and do this: an attack as for ``uavlink-mitm``, or ``all``.

    Raises:
        DemoError: where the daemons do not start or do not link.
        AttackError: there is no such attack, or it takes more than two drones.
    """
    console = console or Console()
    with tempfile.TemporaryDirectory(prefix="uavlinkd-demo-") as folder:
        course = None if attack is None else AttackCourse(attack)
        if seconds is None:
            seconds = SECONDS if course is None else ATTACK_SECONDS * len(course.specs)
        drones = await _make_drones(Path(folder), course)
        try:
            for drone in drones:
                await drone.start()
            summary = await _fly(drones, seconds, console if show else None, course)
        finally:
            for drone in drones:
                await drone.stop()
            if course is not None:
                await course.leave()
    if show:
        console.print(render_summary(summary))
    return summary


async def _make_drones(folder: Path, course: AttackCourse | None) -> tuple[Drone, Drone]:
    ports = free_udp_ports(4)
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
    there, back = Direction(), Direction()
    loop = asyncio.get_running_loop()
    async with AsyncExitStack() as stack:
        for drone, out, into, system_id in ((drones[0], there, back, 1), (drones[1], back, there, 2)):
            settings = AutopilotSettings(system_id=system_id, attitude_rate_hz=ATTITUDE_HZ)
            flight = Flight(drone.endpoint_url, settings, on_sent=out.on_sent, on_received=into.on_received)
            await stack.enter_async_context(flight)
        live = stack.enter_context(Live(console=console, auto_refresh=False, transient=True)) if console else None

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
            said = "\n".join(line for drone in drones for line in drone.last_lines(5))
            raise DemoError(f"the two daemons did not link within {LINK_UP_S:g} s; they said:\n{said}")
        started_at = loop.time()
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
            # What an attacker dropped stays away; that the link carries frames again is what is waited for.
            heard = [there.arrived, back.arrived]
            await until(loop.time() + RECOVERY_S, lambda: there.arrived > heard[0] and back.arrived > heard[1])
            course.is_recovered = there.arrived > heard[0] and back.arrived > heard[1]
    return _summary(drones, (there, back), elapsed, course)


def noticed_by(drones: tuple[Drone, Drone]) -> Counter[str]:
    """What they dropped, and what they noticed where no datagram was to blame."""
    noticed = drops_of(drones)
    for drone in drones:
        noticed.update({sign: drone.peer_status.get(sign, 0) for sign in DISTURBANCES})
    return noticed


def drops_of(drones: tuple[Drone, Drone]) -> Counter[str]:
    """What both daemons have discarded so far, by reason."""
    drops: Counter[str] = Counter()
    for drone in drones:
        drops.update(drone.status.get("drops", {}))
        drops.update(drone.peer_status.get("drops", {}))
    return drops


def _summary(
    drones: tuple[Drone, Drone], directions: tuple[Direction, Direction], seconds: float, course: AttackCourse | None
) -> Summary:
    drops = drops_of(drones)
    for drone in drones:
        drops.update(drone.status["send_failures"])
    round_trips = [s for drone in drones if (s := drone.peer_status["round_trip_s"]) is not None]
    return Summary(
        seconds=round(seconds, 3),
        frames_sent=sum(each.sent for each in directions),
        frames_delivered=sum(each.delivered for each in directions),
        frames_altered=sum(each.altered for each in directions),
        handshakes=drones[0].peer_status["handshakes"],
        drops=dict(drops),
        rtt_ms=round(1000 * min(round_trips), 3) if round_trips else None,
        attacks=None if course is None else course.results(),
        is_recovered=course is None or course.is_recovered,
    )
