"""Attacks on a pair with two paths: their plans, the stage, and their section of the report.

The first path is the faster one, so it is the best path when an attack begins. Heartbeats are critical frames: copies
of them go along every path. Unless a plan says otherwise, the second path works during the attack. Then the link must
stay up, and no critical frame may be lost.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Final

from uavlinkd.core.constants import QUESTION_LIFETIME_S
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.page import ReportSection, Table
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.stage import LINK_UP_S, DaemonStage, StageError
from uavlinkd.lab.evaluation.tampering_plan import TrialPlan
from uavlinkd.lab.evaluation.tampering_records import Run
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.radio import RadioSettings

PATHS: Final = "paths"
SLOWER: Final = ("both/2", RadioSettings(delay_s=0.02))
"""The second path: the election prefers the first one."""
_LASTING_S: Final = 14.0
"""A path that is down gets copies for 10 s after its last answer. Longer attacks show what happens then."""
_LOOK_S: Final = 0.05


def _plan(
    attack: str, phase: str, *needs: str, lasts: bool = True, keeps_link: bool = True, **more: object
) -> TrialPlan:
    """A plan on two paths. ``lasts``: it ends after a time instead of a number of attempts."""
    least: dict[str, object] = {"least_s": _LASTING_S, "targeted": False, "is_variant": True} if lasts else {}
    return TrialPlan(
        attack,
        PATHS,
        (phase,),
        keeps_link=keeps_link,
        needs=needs,
        takes_away=True,
        **{**least, **more},  # type: ignore[arg-type]
    )


PATH_PLANS: tuple[TrialPlan, ...] = (
    _plan("copies on the other path", "replay-data,direction=both/1,onto=2", "duplicate", lasts=False),
    _plan(
        "copies on the other path, after 3 s",
        "replay-data,direction=both/1,onto=2,when=later,delay_s=3",
        "late_copy",
        lasts=False,
        is_variant=True,
    ),
    _plan(
        "copies on the other path, after 10 s",
        "replay-data,direction=both/1,onto=2,when=later,delay_s=10",
        "late_copy",
        lasts=False,
        is_variant=True,
    ),
    _plan(
        "moved to the other path",
        "move,direction=both/1,onto=2",
        "unexpected_answer",
        least_s=3.0,
        is_variant=False,
    ),
    _plan("one path dropped", "drop,direction=both/1", "path_changed", least_s=3.0, is_variant=False),
    _plan("one path dropped, long", "drop,direction=both/1", "path_changed"),
    _plan("one path slowed", "hold,kinds=any,direction=both/1,hold_s=0.2", "path_changed", notes="by 0.2 s"),
    _plan(
        "frames dropped, probes pass",
        "drop,kinds=frames,direction=both/1",
        "path_changed",
        least_s=5.0,
        is_variant=False,
    ),
    _plan("frames dropped, probes pass, long", "drop,kinds=frames,direction=both/1", "path_changed"),
    _plan(
        "stream dropped, copies pass",
        "drop-heartbeats,message_id=30,direction=both/1",
        "path_changed",
        notes="each path looks good while it is not the best",
    ),
    _plan(
        "frames delayed, probes pass",
        "hold,kinds=frames,direction=both/1,hold_s=3",
        "path_changed",
        "delayed",
        after_s=3.5,
        notes="by 3 s",
    ),
    _plan(
        "frames replaced by those of the other path",
        "drop,kinds=frames,direction=both/1 move,direction=both/2,onto=1,beside=true",
        "unexpected_answer",
        notes="of the second path, the copies of the attacker arrive before the genuine datagrams",
    ),
    _plan(
        "one path held and let go",
        "hold,kinds=any,direction=both/1,hold_s=10,at_once=true,seconds=10",
        "path_changed",
        "late_copy",
        least_s=10.0,
        after_s=2.0,
        notes="all datagrams of the path are held for 10 s, then released together",
    ),
    _plan(
        "probes copied to the other path",
        "duplicate,kinds=probe,direction=both/1,onto=2",
        "duplicate",
        least_s=3.0,
        is_variant=False,
    ),
    _plan(
        "probes of one path, faster along the other",
        "move,kinds=probe,direction=both/2,onto=1,beside=true",
        "unexpected_answer",
        notes="the probes of the second path arrive before it along the first one",
    ),
    _plan("probes replayed later", "duplicate,kinds=probe,direction=both/1,when=later,delay_s=1", "duplicate"),
    _plan("bit-flip probes", "bit-flip,kinds=probe,direction=both/1", "bad_tag", least_s=3.0, is_variant=False),
    _plan("bit-flip probes beside genuine ones", "bit-flip,kinds=probe,beside=true", "bad_tag"),
    _plan(
        "responses dropped on one path",
        "drop-message,message=response,direction=both/1",
        "handshakes_unanswered",
        notes="the fastest one",
    ),
    _plan(
        "responses dropped on one path, peer restarted",
        "drop-message,message=response,direction=both/1",
        restarts=True,
        keeps_link=False,
        notes="without a session during the attack",
    ),
    _plan("roam on one path, racing", "roam,direction=both/1", "duplicate", "paths_unproven"),
    _plan(
        "roam on one path, then gone",
        "roam,direction=both/1,mode=instead",
        "paths_unproven",
        noticed_after_s=QUESTION_LIFETIME_S,
    ),
    _plan(
        "many spoofed sources",
        "wander,mode=race",
        "paths_unproven",
        least_s=3.0,
        is_variant=False,
        notes="each datagram arrives first from one of 64 addresses",
    ),
    _plan("many spoofed sources, long", "wander,mode=race", "paths_unproven"),
    _plan(
        "many relayed sources",
        "wander,direction=both/1",
        "paths_unproven",
        validates=True,
        notes="64 addresses, both directions of the first path",
    ),
    _plan("roam on one path, relaying", "roam,direction=both/1,mode=relay", "path_changed", validates=True),
)
"""In their order: the last ones validate strangers."""


class TwoPathStage(DaemonStage):
    """Real daemons with two configured paths between each pair."""

    def __init__(
        self, names: Sequence[str], folder: Path, log: Path, seed: int, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        middle = MiddleHere(names, log, seed, paths=2, radios=(SLOWER,))
        super().__init__(names, folder, middle, link, rate_hz=rate_hz)

    async def settle(self) -> None:
        """Wait until the first path is the best one of every drone.

        Raises:
            StageError: it does not become the best path.
        """
        wanted = {
            (direction.sender, direction.receiver): f"{HOST}:{port}"
            for direction, port in self.middle.ports.items()
            if direction == Direction(direction.sender, direction.receiver)
        }
        until = monotonic() + LINK_UP_S
        while True:
            best = {
                (name, other): peer["path"]
                for name, drone in self.drones.items()
                for other, peer in (await drone.ask()).get("peers", {}).items()
            }
            if best == wanted:
                return
            if monotonic() > until:
                raise StageError(f"the faster path did not become the best one within {LINK_UP_S:g} s: {best}")
            await asyncio.sleep(_LOOK_S)


_ON_PATHS: Final = [
    "A pair of daemons with two paths. The second one is 20 ms slower. The attacks change what happens on the first "
    "one, move datagrams from one path to the other, or send from other addresses. Unless the peer is restarted, the "
    "second path works: then the link must stay up, and no critical frame may be lost. Critical frames are "
    "heartbeats, one frame in twenty. Lost are also states that arrive after a newer one: the daemon drops them. "
    "Longest silence: the longest time without a frame at either client. Changes: how often a drone chose another "
    "best path."
]


def paths_section(run: Run) -> ReportSection:
    """What the attacks on a pair with two paths achieved."""
    rows = []
    for trial in run.trials:
        if trial.group != PATHS:
            continue
        changes = sum(events.get(name, 0) for events in trial.events.values() for name in _changes(events))
        rows.append(
            [
                trial.attack,
                f"{trial.duration_s:.0f} s",
                f"{trial.critical_lost:,} of {trial.critical_sent:,}",
                f"{trial.frames_lost:,} of {trial.frames_sent:,}",
                duration(trial.gap_s),
                str(changes),
                "yes" if trial.stayed_up else "no",
            ]
        )
    head = [
        "attack",
        "duration",
        "critical frames lost",
        "all frames lost",
        "longest silence",
        "changes",
        "link stayed up",
    ]
    return ReportSection("Two paths", "", _ON_PATHS, [Table(head, rows)])


def _changes(events: Mapping[str, int]) -> list[str]:
    return [name for name in events if name.partition(":")[0] == "path_changed"]
