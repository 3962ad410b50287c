"""Attacks of a hostile relay on three daemons that reach each other only along it: their plans, and the stage."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from uavlinkd.config import RelayServer
from uavlinkd.config.keys import encode_key
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.evaluation.middle import HOST, Interventions, interventions, silent_log
from uavlinkd.lab.evaluation.page import ReportSection, Table
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_plan import TrialPlan
from uavlinkd.lab.evaluation.tampering_records import EFFECT_HEAD, Run
from uavlinkd.lab.hostile.hostile_relay import HostileRelay, HostileRelaySettings
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.relay.member_settings import MemberSettings, RelayLimits
from uavlinkd.system.addresses import Address

RELAYED: Final = "relay"
AMPLE: Final = RelayLimits(1_000_000, 10**10)
_LINK: Final = Link((SUITES_BY_NAME["x25519"],), features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS)
_PEERS: Final = 16


def _plan(attack: str, phase: str, *needs: str, **more: object) -> TrialPlan:
    return TrialPlan(attack, RELAYED, (phase,), takes_away=True, needs=needs, **more)  # type: ignore[arg-type]


def _lasting(attack: str, phase: str, least_s: float, *needs: str, **more: object) -> TrialPlan:
    """It ends after a time."""
    return _plan(attack, phase, *needs, targeted=False, least_s=least_s, **more)


RELAYED_PLANS: Final[tuple[TrialPlan, ...]] = (
    _plan("relay drops half", "drop,kinds=any,share=0.5", "envelopes_missing"),
    _lasting("relay drops everything for 1 s", "blackout,seconds=60", 1.0),
    _lasting("relay drops everything for 14 s", "blackout,seconds=60", 14.0, "peer_lost", is_variant=True),
    _plan("relay delays by 3 s", "hold,hold_s=3,share=0.5,limit={target}", "delayed", after_s=3.2),
    _plan("relay duplicates", "duplicate", "duplicate"),
    _plan("relay reorders", "reorder,limit={more}", "envelopes_out_of_order", after_s=3.0),
    _plan("relay misdelivers envelopes", "misroute,kinds=envelope", "unknown_index"),
    _plan("relay misdelivers handshakes", "misroute,kinds=handshake,copies=100", "bad_mac1", least_s=3.0),
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
    _plan(
        "relay lies about addresses", "relay-lie,rate_per_s=100", is_silent=True, notes="a victim's, and special ones"
    ),
    _plan("relay invents handles", "relay-invent", "relay_unknown_handle", "relay_malformed", least_s=3.0),
    _plan("relay sends frames of its own", "relay-frames,rate_per_s=100", "frames_not_allowed"),
    _plan("relay lies about filters", "relay-filter,rate_per_s=100", "relay_unexpected_token"),
    _plan("relay binds the wrong members", "relay-bind-wrong,rate_per_s=100", "unknown_index", least_s=5.0),
    _plan("relay restarts, then replays", "relay-restart", least_s=6.0, notes="every 2.5 s, 512 datagrams each time"),
)
"""The last two leave gaps in the counters, which the daemons report later."""


class MiddleRelay:
    """The hostile relay as the man in the middle of an evaluation, in this process. ``names``: of its members."""

    def __init__(self, names: Sequence[str], log: Path | None, seed: int) -> None:
        self.ports: Mapping[Direction, int] = {}
        """Of a proxy; members reach a relay by its own port."""
        (self.port,) = free_ports(1)
        self._names = tuple(names)
        self._log, self._seed = log, seed
        self._private = os.urandom(c.KEY_BYTES)

    @property
    def section(self) -> dict[str, object]:
        """The ``[[relay]]`` of a member."""
        key = encode_key(KeyPair(self._private).public)
        return {"name": "vps", "public_key": key, "addresses": [f"{HOST}:{self.port}"]}

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start for members with these keys. They reach the relay; it does not need their ports."""
        del addresses
        members = (PeerSettings(name, public_keys[name], None, _LINK) for name in self._names)
        settings = HostileRelaySettings(
            name="vps",
            private_key=Secret(self._private),
            listen=(Address(HOST, self.port),),
            server=RelayServer(tuple(MemberSettings(member, _PEERS, AMPLE) for member in members), AMPLE),
            seed=self._seed,
            log=self._log,
        )
        self.relay = HostileRelay(settings)
        self.relay.log = silent_log()
        await self.relay.start()

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks."""
        assert not objects, "this attacker has no key of a member"
        self.relay.attack(specs)

    async def statistics(self) -> Interventions:
        """The counters so far."""
        return interventions(self.relay.statistics())

    async def stop(self) -> None:
        """Stop."""
        await self.relay.stop()


class RelayStage(DaemonStage):
    """Daemons that know only a relay."""

    def __init__(
        self, names: Sequence[str], folder: Path, relay: MiddleRelay, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        super().__init__(names, folder, relay, link, rate_hz=rate_hz)
        self._relay = relay

    def addresses(self, one: str, other: str) -> list[object]:
        """None: the relay finds the peer."""
        del one, other
        return []

    def relays(self, name: str) -> list[dict[str, object]]:
        """The hostile one."""
        del name
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
