"""``uavlinkd demo``: two real daemons on loopback, each with a client; every frame is checked.

With ``--attack``, the man in the middle between the two runs one attack after the other. With ``--web`` a browser
shows the page of one daemon.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, ExitStack, nullcontext
from pathlib import Path
from time import monotonic

from rich.console import Console
from rich.live import Live

from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.demo.screen import AttackResult, Summary, render, render_summary
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.records import EvaluationError
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.mitm.attack import AttackContext
from uavlinkd.lab.mitm.attacks import ATTACKS, AttackSpec, parse_attack
from uavlinkd.lab.sim.drone_process import DroneError
from uavlinkd.protocol.constants import LATE_AFTER_S, LATE_STEP_S
from uavlinkd.protocol.drops import LinkProblem

DEMO_ERRORS = (DroneError, EvaluationError)
"""The demo failed. The message is for the operator."""
NAMES = ("drone0", "drone1")
DRAIN_S = 15.0
"""How long the last frames may take to arrive."""
RATE_HZ = 70.0
SCREEN_S = 0.25
SECONDS = 15.0
ATTACK_SECONDS = 3.0
ATTACKED_SHARE = 2 / 3
"""Share of each attack's time in which it is active. In the rest the link recovers."""
RECOVERY_S = 2.0
"""Within this time after the last attack, frames must be delivered again."""
ALL = "all"
LINK: dict[str, object] = {"rekey_after_s": 4.0}
"""A rekey in seconds instead of two minutes, so that the demo shows some."""
ATTACKED_LINK: dict[str, object] = {
    "suites": ["ffdhe2048", "x25519"],
    "rekey_after_s": 1.0,
    "reject_after_s": 10.0,
    "retry_max_s": 1.0,
}
"""Frequent rekeys with a group's share in each handshake, so that every attack finds a target."""

_LOAD = "flood-initiations,rate_per_s=600"
_NEEDS_LOAD = ("replay-cookie", "stolen-cookie")
"""These attacks need cookies, which daemons require only under load."""
_NEEDS_MORE = ("misroute", "move")
"""These attacks need a third peer, or a second path."""
_WITHHOLDS = ("drop", "drop-heartbeats", "blackout", "hold", "truncate", "tamper-tag")
_DETECTION_S = LATE_AFTER_S + 2 * LATE_STEP_S + 0.2
"""A drone counts a missing envelope when it is too late to arrive."""
_OPTIONS = {
    "replay-cookie": ",copies=3",
    "drop": ",share=0.5",
    "hold": ",hold_s=0.5,share=0.5",
    "blackout": ",seconds=60",
}


def attacks_of(text: str) -> list[AttackSpec]:
    """The attacks that ``--attack`` names: one as for ``uavlink-mitm``, or ``all``.

    Raises:
        AttackError: there is no such attack, or it needs more than two peers or one path.
    """
    names = [name + _OPTIONS.get(name, "") for name in ATTACKS if name not in _NEEDS_MORE] if text == ALL else [text]
    specs = [parse_attack(name) for name in names]
    for spec in specs:
        spec.make(AttackContext.between(*NAMES, public_keys=dict.fromkeys(NAMES, bytes(32))))
    return specs


async def run_demo(
    seconds: float | None = None,
    *,
    show: bool,
    attack: str | None = None,
    console: Console | None = None,
    serve: Callable[[Path], AbstractAsyncContextManager[None]] | None = None,
) -> Summary:
    """Run the demo, on a live screen if ``show``.

    Args:
        seconds: of traffic; by default :data:`SECONDS`, or with attacks :data:`ATTACK_SECONDS` for each.
        attack: an attack between the drones, as for ``uavlink-mitm``, or ``all``.
        serve: serves the page of the daemon with this control socket, until a person ends it.

    Raises:
        DroneError, EvaluationError: the daemons do not start or do not link.
        AttackError: there is no such attack, or it needs more than two drones.
    """
    console = console or Console()
    specs = None if attack is None else attacks_of(attack)
    if seconds is None:
        seconds = ATTACK_SECONDS * len(specs) if specs else math.inf if serve else SECONDS
    link = LINK if specs is None else {**LINK, **ATTACKED_LINK}
    with private_folder("uavlinkd-demo-") as folder, ExitStack() as stack:
        # The summary replaces the live screen; after Ctrl-C it remains.
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if show and not serve else None
        try:
            stage = DaemonStage(NAMES, folder, MiddleHere(NAMES, 0), link, rate_hz=RATE_HZ)
            page = serve(stage.drones[NAMES[0]].socket) if serve else nullcontext()
            async with stage, page:
                summary = await Demo(stage, live).run(seconds, specs, lingers=serve is not None)
        except asyncio.CancelledError:
            if show:
                console.print("Interrupted. The daemons have stopped, and their keys are deleted.")
            raise
        if live is not None:
            live.update(render_summary(summary), refresh=True)
        elif show:
            console.print(render_summary(summary))
    return summary


class Demo:
    """A demo that runs, with the results of its attacks."""

    def __init__(self, stage: DaemonStage, live: Live | None) -> None:
        self.stage = stage
        self.results: list[AttackResult] = []
        self.is_attacking = False
        self._live = live
        self._began = stage.ledger.mark()
        self._drops_before = Counter[str]()
        self._noticed_before = Counter[str]()
        self._attempts_before = 0

    async def run(self, seconds: float, specs: list[AttackSpec] | None, *, lingers: bool) -> Summary:
        """Run; ``lingers``: after the attacks, until a person ends it."""
        stage, ledger, began_at = self.stage, self.stage.ledger, monotonic()
        await self._look(began_at + seconds)
        self._drops_before, self._began = self.drops(), ledger.mark()  # before, there was no session
        is_recovered = True
        if specs is None:
            await self.until(began_at + seconds)
        for spec in specs or ():
            await self.attack(spec, seconds / len(specs or ()))
        is_attacked = specs is not None
        if is_attacked and lingers:
            await self.until(math.inf)
        end, elapsed_s = ledger.mark(), monotonic() - began_at
        if not is_attacked:
            await self.until(monotonic() + DRAIN_S, lambda: len(set(ledger.count(self._began, end))) == 1)
        else:
            ledger.await_recovery(monotonic())
            is_recovered = await self.until(monotonic() + RECOVERY_S, lambda: ledger.recovery_s is not None)
        sent, delivered = ledger.count(self._began, end)
        peers = [peer for drone in stage.drones.values() for peer in drone.peer_statuses]
        round_trips = [peer["round_trip_s"] for peer in peers if peer["round_trip_s"] is not None]
        return Summary(
            seconds=round(elapsed_s, 3),
            frames_sent=sent,
            frames_delivered=delivered,
            frames_altered=ledger.faults.total(),
            handshakes=peers[0]["handshakes"],
            drops=dict(self.drops() - self._drops_before),
            rtt_ms=round(1000 * min(round_trips), 3) if round_trips else None,
            attacks=self.results if is_attacked else None,
            is_recovered=is_recovered,
        )

    def drops(self) -> Counter[str]:
        """What the daemons dropped, by reason: datagrams, outgoing frames, and frames that they refused."""
        drops = Counter[str]()
        for status in (drone.status for drone in self.stage.drones.values()):
            drops.update({**status["drops"], **status["send_failures"], "stale": sum(status["stale"].values())})
            for sender in (*status["endpoints"].values(), *status["peers"].values()):
                drops.update(sender.get("drops", {}))
                for reasons in sender["refused"]["in"].values():
                    drops.update({f"refused_{reason}": count for reason, count in reasons.items()})
        return +drops

    async def attack(self, spec: AttackSpec, share_s: float) -> None:
        """Attack for a part of this time, and let the link recover in the rest."""
        middle, begin_at = self.stage.middle, monotonic()
        needs_load = spec.name in _NEEDS_LOAD or "cookie" in str(spec.options)
        self._attempts_before = await self._attempts(spec.name)
        self._noticed_before = self._noticed()
        self.results.append(AttackResult(str(spec)))
        self.is_attacking = True
        await middle.attack([*([_LOAD] if needs_load else []), str(spec)])
        await self.until(begin_at + ATTACKED_SHARE * share_s)
        await middle.attack([])
        await self.until(begin_at + share_s + (_DETECTION_S if spec.name in _WITHHOLDS else 0.0))
        self.is_attacking = False

    async def _attempts(self, name: str) -> int:
        return sum((await self.stage.middle.statistics()).of([name]).values())

    def _noticed(self) -> Counter[str]:
        """The counters of dropped datagrams and of link problems, of both drones."""
        noticed = self.drops()
        for drone in self.stage.drones.values():
            for peer in drone.peer_statuses:
                noticed.update({sign: peer[sign] for sign in LinkProblem})
        return noticed

    async def until(self, done_at: float, is_done: Callable[[], bool] = lambda: False) -> bool:
        while not is_done() and monotonic() < done_at:
            await self._look(done_at)
            await asyncio.sleep(min(SCREEN_S, max(0.0, done_at - monotonic())))
        await self._look(done_at)
        return is_done()

    def frames(self) -> dict[str, int]:
        """Those sent and delivered so far, and what was delivered but not sent so: forged, altered or replayed."""
        ledger = self.stage.ledger
        sent, delivered = ledger.count(self._began, ledger.mark())
        return {"sent": sent, "delivered": delivered, "altered": ledger.faults.total()}

    async def _look(self, done_at: float) -> None:
        for drone in self.stage.drones.values():
            await drone.ask()
        if self.is_attacking:
            result = self.results[-1]
            result.interventions = await self._attempts(result.name.partition(",")[0]) - self._attempts_before
            result.noticed = dict(self._noticed() - self._noticed_before)
        if self._live is not None:
            frames, drops = self.frames(), self.drops() - self._drops_before
            left_s = done_at - monotonic()
            self._live.update(render(self.stage.drones.values(), frames, drops, left_s, self.results), refresh=True)
