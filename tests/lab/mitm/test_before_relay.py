"""Every attack on the paths between a member and its relay: no false frame is accepted, and the link recovers.

Once on the datagrams of that way, once on those of the two members inside. The relay is honest.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import pytest

from uavlinkd.config.keys import decode_key
from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_bench import Bench
from uavlinkd.lab.evaluation.tampering_plan import LOAD, PATH_PLANS, TamperingSettings, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import NOT_IN_TIME, RECOVERY_LIMIT_S, Trial, Verdict
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.attacks import ATTACKS
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports

RELAY: Final = "vps"
DRONES: Final = ("drone0", "drone1")


class RelayProcess(DroneProcess):
    """``uavlinkd relay`` with these members."""

    command = "relay"

    def configure_members(self, link: Mapping[str, object], members: Mapping[str, str]) -> None:
        """Write the configuration. ``members``: public keys by name."""
        tables = [("[link]", link)]
        tables += [("[[member]]", {"name": name, "public_key": key}) for name, key in members.items()]
        self.write(tables)


class MiddleBeforeRelay(MiddleHere):
    """A proxy on each path to the relay, along two paths; none on a way between members."""

    def __init__(self, log: Path | None, seed: int) -> None:
        super().__init__((*DRONES, RELAY), log, seed, paths=2)
        self.ports: dict[Direction, int] = {
            direction: port
            for direction, port in self.ports.items()
            if RELAY in (direction.sender, direction.receiver)
        }


class StageBeforeRelay(DaemonStage):
    """The daemons know no address of each other. ``link``: of the daemons and of the relay."""

    def __init__(
        self, folder: Path, middle: MiddleBeforeRelay, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        super().__init__(DRONES, folder, middle, link, rate_hz=rate_hz)
        port, unused = free_ports(2)
        self._relay = RelayProcess(RELAY, folder / RELAY, port, unused)
        self._relay.configure_members(link, {name: drone.public_key for name, drone in self.drones.items()})

    async def open(self) -> None:
        await self._relay.start()
        await super().open()

    async def close(self) -> None:
        await super().close()
        await self._relay.stop()

    def attacked(self) -> tuple[dict[str, int], dict[str, bytes]]:
        ports, keys = super().attacked()
        return {**ports, RELAY: self._relay.port}, {**keys, RELAY: decode_key(self._relay.public_key)}

    def addresses(self, one: str, other: str) -> list[object]:
        """None: the relay finds the peer."""
        del one, other
        return []

    def relays(self, name: str) -> list[dict[str, Any]]:
        """The relay, in front of the man in the middle."""
        ports = [port for direction, port in self.middle.ports.items() if direction[:2] == (name, RELAY)]
        addresses = [f"{HOST}:{port}" for port in ports]
        return [{"name": RELAY, "public_key": self._relay.public_key, "addresses": addresses}]


LINK = {"suites": ["ffdhe2048", "x25519"], "rekey_after_s": 1.0, "reject_after_s": 6.0}
ALL = (
    *(*plans.HANDSHAKE_PLANS, *plans.DATA_PLANS, *plans.FLOOD_PLANS, *plans.TRAFFIC_PLANS, *plans.MISROUTE_PLANS),
    *(plan for plan in PATH_PLANS if "move" in plan.names),
    *plans.LAST_PLANS,
)
CHOSEN = [replace(plan, keeps_link=False) for plan in ALL if not plan.is_variant]
WITHOUT_TARGET = {"alter-frame", "drop-heartbeats"}
"""Attacks that find nothing outside: all frames are inside."""
OF_FLEETS = {"certificate-length"}
OUTSIDE, INSIDE = "outside", "inside"


def _plans(where: str) -> list[TrialPlan]:
    """The plans between a member and the relay."""
    if where == OUTSIDE:
        return [_placed(plan, "") for plan in CHOSEN if not WITHOUT_TARGET & set(plan.names)]
    return [_placed(plan, ",inside=true") for plan in CHOSEN]


def _placed(plan: TrialPlan, more: str) -> TrialPlan:
    phases = [
        " ".join(
            # Inside, a datagram from another address has no handle: the load comes from the relay's address.
            spec.replace("drone0>drone1", "drone0>vps").replace(LOAD, f"{LOAD},sources=0" if more else LOAD) + more
            for spec in phase.split()
        )
        for phase in plan.phases
    ]
    return replace(plan, phases=tuple(phases))


def test_every_attack_is_tried() -> None:
    """Inside. Those that alter or select frames find none outside."""
    tried = {spec.partition(",")[0] for plan in _plans(INSIDE) for phase in plan.phases for spec in phase.split()}
    assert tried == set(ATTACKS) - OF_FLEETS


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    """One for each place of the attacks."""
    made = {where: tmp_path / where for where in (OUTSIDE, INSIDE)}
    for folder in made.values():
        folder.mkdir()
    return made


@pytest.mark.long
async def test_attacks_before_the_relay(folders: dict[str, Path]) -> None:
    """Each has targets, and none of them succeeds. Outside and inside at the same time: each needs five minutes."""
    both = await asyncio.gather(*(_attack(where, folder) for where, folder in folders.items()))
    trials = [trial for trials in both for trial in trials]
    failed = [
        (trial.attack, trial.verdict, trial.successes)
        for trial in trials
        if trial.verdict is Verdict.BROKEN or (trial.recovery_s is None or set(trial.successes) - {NOT_IN_TIME})
    ]
    assert failed == []
    # A busy machine may recover late once: the evaluation limits each.
    assert median(trial.recovery_s or 0.0 for trial in trials) <= RECOVERY_LIMIT_S


async def _attack(where: str, folder: Path) -> list[Trial]:
    stage = StageBeforeRelay(folder, MiddleBeforeRelay(folder / "journal", 1), LINK, rate_hz=100.0)
    trials: list[Trial] = []
    bench = Bench(stage, TamperingSettings(quick=True), trials.append)
    async with stage:
        await bench.run_control()
        for plan in _plans(where):
            await bench.run(plan)
    return trials
