"""Attacks of a hostile relay on three daemons that reach each other only along it: their plans, and the stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from uavlinkd.lab.evaluation.hostile_relay import HostileRelay
from uavlinkd.lab.evaluation.page import ReportSection, Table
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_plan import TrialPlan
from uavlinkd.lab.evaluation.tampering_records import EFFECT_HEAD, Run

RELAYED: Final = "relay"


def _plan(attack: str, phase: str, *needs: str, **more: object) -> TrialPlan:
    return TrialPlan(attack, RELAYED, (phase,), takes_away=True, needs=needs, **more)  # type: ignore[arg-type]


def _lasting(attack: str, phase: str, least_s: float, *needs: str, **more: object) -> TrialPlan:
    """It ends after a time."""
    return _plan(attack, phase, *needs, targeted=False, least_s=least_s, **more)


RELAYED_PLANS: Final[tuple[TrialPlan, ...]] = (
    _plan("relay drops half", "drop,kinds=any,share=0.5", "envelopes_missing"),
    _lasting("relay drops everything for 1 s", "blackout,seconds=60", 1.0),
    _lasting("relay drops everything for 8 s", "blackout,seconds=60", 8.0, "peer_lost", is_variant=True),
    _plan("relay delays by 3 s", "hold,hold_s=3,share=0.5,limit={target}", "delayed", after_s=3.2),
    _plan("relay duplicates", "duplicate", "duplicate"),
    _plan("relay reorders", "reorder,limit={more}", "envelopes_out_of_order", after_s=3.0),
    _plan("relay misdelivers envelopes", "misroute,kinds=envelope", "unknown_index"),
    _plan(
        "relay misdelivers handshakes", "misroute,kinds=handshake,copies=20", "bad_mac1", least_s=3.0, targeted=False
    ),
    _plan("relay alters", "bit-flip,beside=true", "bad_tag"),
    _plan("relay forges", "forge-data,rate_per_s=1500", "bad_tag"),
    _plan("relay replays", "replay-data,copies=2", "duplicate"),
    _plan("relay replays later", "replay-data,when=later,delay_s=3", least_s=4.0, is_variant=True),
    _lasting(
        "relay replays after a member's restart",
        "replay-data,when=restart,rate_per_s=3000,copies=24",
        3.0,
        restarts=True,
        is_variant=True,
    ),
    _lasting("relay lies about addresses", "relay-lie", 3.0, is_silent=True, notes="a victim's, and special ones"),
    _lasting("relay invents handles", "relay-invent", 3.0, "relay_unknown_handle", "relay_malformed"),
    _lasting("relay sends frames of its own", "relay-frames", 3.0, "frames_not_allowed"),
    _lasting("relay binds the wrong members", "relay-bind-wrong", 5.0, "unknown_index"),
    _lasting("relay restarts, then replays", "relay-restart", 6.0, notes="every 2.5 s, 512 datagrams each time"),
)
"""The last two leave gaps in the counters, which the daemons report later."""


class RelayStage(DaemonStage):
    """Daemons that know only a relay."""

    def __init__(
        self, names: Sequence[str], folder: Path, relay: HostileRelay, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        super().__init__(names, folder, relay, link, rate_hz=rate_hz)
        self._relay = relay

    def addresses(self, one: str, other: str) -> list[object]:
        """None: the relay finds the peer."""
        del one, other
        return []

    def relays(self) -> list[dict[str, object]]:
        """The hostile one."""
        return [self._relay.section]


_ON_RELAY: Final = [
    "Three daemons that reach each other only along a hostile relay. It holds a relay's key, and no key of a member: "
    "it has sessions with the members as every relay. It makes of the datagrams that it forwards what a man in the "
    "middle makes, and lies in its own records. When it bound the wrong members, it reports the true handles at "
    "the end. An attempt is one datagram or record. What a relay can do is to deny service.",
]


def relay_section(run: Run) -> ReportSection:
    """What a hostile relay achieved."""
    rows = [
        [
            *trial.effect,
            "not in 5 s" if trial.recovery_s is None else duration(trial.recovery_s),
            ", ".join(trial.reasons) or "-",
        ]
        for trial in run.trials
        if trial.group == RELAYED
    ]
    head = [
        *EFFECT_HEAD,
        "recovery",
        "noticed by",
    ]
    return ReportSection("A hostile relay", "", _ON_RELAY, [Table(head, rows)])
