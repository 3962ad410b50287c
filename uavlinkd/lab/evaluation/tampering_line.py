"""Attacks on a serial line between two daemons: their plans, the modems with the attacker, and the stage.

The attacker is the modem's firmware, or a device on the wires. It puts bytes on the lines to both hosts, or holds
back what they should receive. It has no keys, but it knows the framing: it makes frames with a valid CRC.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Final

from uavlinkd.lab.evaluation.middle import Interventions, silent_log
from uavlinkd.lab.evaluation.page import ReportSection, Table
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_plan import TrialPlan
from uavlinkd.lab.evaluation.tampering_records import EFFECT_HEAD, Run
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.mitm.line_attacks import parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings

LINE: Final = "line"
SIK: Final = ModemSettings()
RATE_HZ: Final = 10.0
"""Frames per second of each client. The radio carries more, so a lost frame was lost by the attack."""
_ENDS: Final = dict(zip(ModemEnd, ("drone0", "drone1"), strict=True))


def _plan(attack: str, phase: str, *needs: str, **more: object) -> TrialPlan:
    return TrialPlan(attack, LINE, (phase,), takes_away=True, needs=needs, **more)  # type: ignore[arg-type]


def _held(attack: str, phase: str, duration_s: float, *needs: str, **more: object) -> TrialPlan:
    """A modem holds everything back for some time, and then lets go."""
    phase = f"line-hold,hold_s={duration_s:g},interval_s=1000,{phase}"
    return _plan(attack, phase, *needs, targeted=False, least_s=duration_s, after_s=3.0, **more)


LINE_PLANS: Final[tuple[TrialPlan, ...]] = (
    # The first three add no whole datagram to the recorded ones, from which the fourth one selects.
    _plan("bytes injected on the line", "line-noise,interval_s=0.1", "line_noise", notes="64 random bytes each time"),
    _plan("line frames with one altered byte", "line-bad-crc,interval_s=0.025", "line_noise"),
    _plan("line frames cut at every offset", "line-cut,interval_s=0.1", "line_noise"),
    _plan("datagrams replayed on the line", "line-replay,interval_s=0.025", "duplicate"),
    _plan("datagrams forged on the line", "line-forge,interval_s=0.025", "bad_tag", "unknown_index"),
    _held("line held for 3 s and let go", "end=both", 3.0),
    _held("line held for 10 s and let go", "end=both", 10.0, "peer_lost", is_variant=True),
    _held("line held for 10 s in one direction", "end=right", 10.0, is_variant=True),
)
"""On a link with a rekey every ten seconds."""


class MiddleLine:
    """Two emulated modems in this process, with the attacks on their lines."""

    def __init__(self, folder: Path, log: Path | None, seed: int) -> None:
        self.ports: Mapping[Direction, int] = {}
        self.devices = {name: folder / end for end, name in _ENDS.items()}
        left, right = self.devices.values()
        self._modems = ModemPorts(PortSettings(left, right, SIK, seed=seed, log=log))
        self._modems.log = silent_log()

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Plug both modems in. They need to know nothing about the daemons."""
        del addresses, public_keys
        await self._modems.start()

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks. What the modems hold back is released."""
        assert not objects, "the attacker on the line has no keys"
        self._modems.change_attacks([parse_line_attack(text) for text in specs])
        for end in ModemEnd:
            self._modems.link.release(end, monotonic())

    async def statistics(self) -> Interventions:
        """The counters so far."""
        counts = self._modems.journal.counts
        return Interventions({f"{attack}: {operation}": count for (attack, operation), count in counts.items()})

    async def stop(self) -> None:
        """Pull both modems out."""
        await self._modems.stop()


class LineStage(DaemonStage):
    """Two daemons whose only path is a serial line with two modems."""

    def __init__(
        self, names: Sequence[str], folder: Path, middle: MiddleLine, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        super().__init__(names, folder, middle, link, rate_hz=rate_hz)
        self._devices = middle.devices

    def addresses(self, one: str, other: str) -> list[object]:
        """The line."""
        del one, other
        return [{"network": "sik"}]

    def networks(self, name: str) -> list[dict[str, object]]:
        """The line, at this drone's end."""
        return [{"name": "sik", "serial": f"{self._devices[name]}:{SIK.line_baud:.0f}"}]


_ON_LINE: Final = [
    "A pair of daemons whose only path is a serial line with two emulated SiK modems: 57,600 baud, 24 kbit/s in both "
    "directions together, half duplex. Each client sends ten frames per second. The attacker is the firmware of the "
    "modems or a device on the wires: it attacks the lines to both hosts. An attempt is one injection, or one modem "
    "that holds everything back. Injected bytes take room on the line and damage the genuine frames that they hit.",
]


def line_section(run: Run) -> ReportSection:
    """What the attacks on a serial line achieved."""
    rows = [
        [
            *trial.effect,
            ", ".join(trial.reasons) or "-",
        ]
        for trial in run.trials
        if trial.group == LINE
    ]
    head = [*EFFECT_HEAD, "noticed by"]
    return ReportSection("On a serial line", "", _ON_LINE, [Table(head, rows)])
