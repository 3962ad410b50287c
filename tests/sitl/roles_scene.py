"""One scene: an autopilot on the ground or in the air receives frames that a role passes; then none, to compare."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.roles_frames import RoleFrames
from tests.sitl.roles_judge import Judge, Snapshot, changed_parameters, differences
from tests.sitl.roles_links import LinkClosedError, dropped_datagrams
from tests.sitl.roles_station import Station, StationError
from tests.sitl.roles_vehicles import Vehicle
from uavlinkd.lab.sim.autopilot import HOME

BATCH: Final = 100
"""Frames between two barriers: what fits into the queues of the kernel and of the autopilot."""
CHUNK: Final = 50_000
"""Frames between two whole snapshots."""
MakeVehicle = Callable[[Path], Vehicle]
Say = Callable[[str], None]
_RELATIVE: Final = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT


@dataclass(slots=True)
class SceneResult:
    """The result of one scene."""

    role: str
    is_flying: bool
    frames: int = 0
    by_message: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    """Of the autopilot's time, from the first frame to the last snapshot."""
    lost: int = 0
    """Datagrams that the kernel dropped."""
    repeated_barriers: int = 0
    parameters: int = 0
    changed_by_itself: tuple[str, ...] = ()
    """Parameters that changed in a quiet run too."""
    changed_in_quiet: tuple[str, ...] = ()
    """Everything else that changed in a quiet run."""
    farthest_m: float = 0.0
    texts: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    changes: tuple[str, ...] = ()
    culprits: tuple[bytes, ...] = ()
    """The fewest frames that repeat a change."""

    @property
    def title(self) -> str:
        """Role and place."""
        return f"{self.role} {'in the air' if self.is_flying else 'on the ground'}"


class Trial:
    """One autopilot with a mission, a fence and rally points; in the air, if asked for."""

    def __init__(self, make: MakeVehicle, *, is_flying: bool) -> None:
        self._make = make
        self._is_flying = is_flying
        self._exits = ExitStack()
        self.vehicle: Vehicle
        self.station: Station
        self.judge: Judge

    def __enter__(self) -> Self:
        with ExitStack() as exits:
            folder = Path(exits.enter_context(tempfile.TemporaryDirectory(prefix="uavlinkd-roles-")))
            vehicle = self.vehicle = self._make(folder / "autopilot")
            self.station = exits.enter_context(vehicle)
            for plan, items in plans().items():
                with suppress(StationError):  # the project's simulator has missions only
                    self.station.write_plan(plan, items)
            if self._is_flying:
                vehicle.take_off(self.station)
            else:
                self.station.until(lambda: "LOCAL_POSITION_NED" in self.station.seen.number, "a local position")
                self.station.pass_time(vehicle.settle_s)
            self.judge = Judge(self.station)
            self.judge.begin()
            self._exits = exits.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exits.close()

    def send(self, frames: Sequence[bytes]) -> int:
        """Send frames until the judge reports a change, or the autopilot ends; how many were sent."""
        station = self.station
        for begin in range(0, len(frames), BATCH):
            try:
                station.attacker.send(frames[begin : begin + BATCH])
                station.wait_for_attacker()
            except LinkClosedError:
                self.judge.changes.append(self.vehicle.why_ended())
            if self.judge.changes:
                return min(begin + BATCH, len(frames))
        return len(frames)

    def snapshot_after(self, before: Snapshot, *, with_rates: bool) -> Snapshot:
        """The state after frames; that before, if the autopilot ended: then it has none."""
        if self.judge.changes:
            return before
        try:
            return self.judge.snapshot(with_rates=with_rates)
        except LinkClosedError:
            self.judge.changes.append(self.vehicle.why_ended())
        return before


def run_scene(
    make: MakeVehicle, role: str, frames: int, seed: int, *, is_flying: bool, write: Say = print
) -> SceneResult:
    """Send frames, and compare the autopilot's state before and after; the same without frames; then narrow down.

    Raises:
        StationError: the autopilot does not do what the scene needs.
    """
    generator = RoleFrames(role, seed)
    result = SceneResult(role, is_flying)
    chunks: list[list[bytes]] = []
    with Trial(make, is_flying=is_flying) as trial:
        station, judge = trial.station, trial.judge
        snapshots = [judge.snapshot(with_rates=True)]
        began_s = station.time_s
        while result.frames < frames and not judge.changes:
            chunks.append([generator.draw() for _ in range(min(CHUNK, frames - result.frames))])
            result.frames += trial.send(chunks[-1])
            snapshots.append(trial.snapshot_after(snapshots[0], with_rates=result.frames == frames))
            write(f"{result.title}: {result.frames:,} frames, {station.time_s - began_s:.0f} s of its time")
        result.seconds = station.time_s - began_s
        result.by_message = generator.counts.by_message
        result.parameters = len(snapshots[0].parameters)
        result.repeated_barriers = station.attacker.repeated_barriers
        result.lost = dropped_datagrams(station.attacker.peer_port or -1)
        result.farthest_m = judge.farthest_m
        result.texts = Counter(station.seen.texts)
        result.answers = station.sent_to_attacker
        watched = tuple(judge.changes)
    calm = run_quiet(make, result.seconds, is_flying=is_flying)
    result.changed_by_itself = tuple(sorted(calm.parameters))
    result.changed_in_quiet = calm.changes
    changes = (*watched, *differences(snapshots[0], snapshots[-1], calm.parameters))
    in_quiet = {_subject(change) for change in calm.changes}
    result.changes = tuple(change for change in changes if _subject(change) not in in_quiet)
    if result.changes:
        write("\n".join([f"{result.title}: CHANGED", *result.changes]))
        culprit_chunk = next(
            (
                chunk
                for chunk, before, after in zip(chunks, snapshots, snapshots[1:], strict=False)
                if differences(replace(before, rates={}), replace(after, rates={}), calm.parameters)
            ),
            chunks[-1],
        )
        result.culprits = tuple(find_culprits(make, culprit_chunk, calm.parameters, is_flying=is_flying, write=write))
    return result


def _subject(change: str) -> str:
    return change.partition(":")[0]


class Calm(NamedTuple):
    """What changes without any frame of an attacker."""

    parameters: frozenset[str]
    changes: tuple[str, ...]


def run_quiet(make: MakeVehicle, seconds: float, *, is_flying: bool) -> Calm:
    """The same scene for as many seconds of the autopilot's time, without frames."""
    with Trial(make, is_flying=is_flying) as trial:
        before = trial.judge.snapshot(with_rates=True)
        trial.station.pass_time(seconds)
        after = trial.judge.snapshot(with_rates=True)
        watched = tuple(trial.judge.changes)
    parameters = frozenset(changed_parameters(before, after))
    return Calm(parameters, (*watched, *differences(before, after, parameters)))


def find_culprits(
    make: MakeVehicle, frames: Sequence[bytes], own: Iterable[str], *, is_flying: bool, write: Say
) -> Sequence[bytes]:
    """The fewest frames that repeat a change in an autopilot that was just started; none if it does not come back."""

    def breaks(some: Sequence[bytes]) -> bool:
        with Trial(make, is_flying=is_flying) as trial:
            before = trial.judge.snapshot(with_rates=True)
            trial.send(some)
            after = trial.snapshot_after(before, with_rates=True)
            is_changed = bool(trial.judge.changes or differences(before, after, own))
        write(f"{len(some):,} frames {'repeat the change' if is_changed else 'change nothing'}")
        return is_changed

    return narrow(frames, breaks) if breaks(frames) else ()


def narrow(frames: Sequence[bytes], breaks: Callable[[Sequence[bytes]], bool]) -> Sequence[bytes]:
    """Halve frames that break something, as long as one of the halves breaks it by itself."""
    while len(frames) > 1:
        middle = len(frames) // 2
        for half in (frames[:middle], frames[middle:]):
            if breaks(half):
                frames = half
                break
        else:
            break
    return frames


def plans() -> Mapping[int, list[Any]]:
    """A mission, a fence around the vehicle and one rally point."""
    latitude, longitude = round(HOME.latitude_deg * 1e7), round(HOME.longitude_deg * 1e7)

    def item(plan: int, seq: int, command: int, offset: tuple[int, int], height_m: float, first: float = 0) -> Any:
        place = latitude + offset[0], longitude + offset[1], height_m
        return mavlink.MAVLink_mission_item_int_message(
            1, 1, seq, _RELATIVE, command, 0, 1, first, 0, 0, float("nan") if plan == 0 else 0, *place, plan
        )

    corners = ((-20000, -20000), (-20000, 20000), (20000, 20000), (20000, -20000))
    fence, rally = mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_MISSION_TYPE_RALLY
    vertex = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    return {
        mavlink.MAV_MISSION_TYPE_MISSION: [
            item(0, 0, mavlink.MAV_CMD_NAV_WAYPOINT, (0, 0), 20),
            item(0, 1, mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0), 20),
            item(0, 2, mavlink.MAV_CMD_NAV_WAYPOINT, (3000, 0), 25),
            item(0, 3, mavlink.MAV_CMD_NAV_WAYPOINT, (3000, 3000), 30),
        ],
        fence: [item(fence, seq, vertex, corner, 0, 4) for seq, corner in enumerate(corners)],
        rally: [item(rally, 0, mavlink.MAV_CMD_NAV_RALLY_POINT, (1000, 1000), 20)],
    }
