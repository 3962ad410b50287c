"""What is tried: every attack of the man in the middle, in the variants that differ in what they try.

A plan's *phases* follow one another; in each the man in the middle is told one line of attacks. The first of a line
is the attack, what else stands there helps it (a flood, say, without which no cookies are asked for).
"""

from __future__ import annotations

from dataclasses import dataclass

HANDSHAKE, DATA, FLOOD, TRAFFIC, KEYS = "handshake", "data", "flood", "traffic", "keys"
LOAD = "flood-initiations,rate_per_s=600"
"""Under which cookies are asked for."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One row of the table."""

    attack: str
    group: str
    phases: tuple[str, ...]
    paper: str | None = None
    """What the same is against the paper's protocol; None where that has nothing to attack. Here as in the phases
    ``{target}`` stands for the number of attempts, ``{more}`` for a fifth more."""
    restarts: bool = False
    """A drone is killed and started again while it lasts."""
    is_silent: bool = False
    """It knows no public key: nothing may come back."""
    validates: bool = False
    """Its addresses carry answers on, and so prove themselves: they may get more than they sent."""
    least_s: float = 0.3
    """How long it lasts at least: where it waits for something."""
    after_s: float = 0.0
    """How long it goes on after the last attempt: what it holds is released."""
    targeted: bool = True
    """Whether attempts count; else time."""
    takes_away: bool = False
    """Envelopes do not arrive, or in another order, or from elsewhere: what the drones make of it they know later."""
    is_variant: bool = False
    """Left out of a quick run: another row of it has the same attack."""
    notes: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the attacks whose interventions are attempts: the first of each phase."""
        return tuple(dict.fromkeys(phase.split()[0].split(",")[0] for phase in self.phases))


def with_target(phase: str, target: int) -> str:
    """What the man in the middle is told, where so many attempts are wanted."""
    return phase.replace("{target}", str(target)).replace("{more}", str(target + target // 5))


def _alter(name: str, *, on_paper: bool) -> Plan:
    """In place: the genuine message does not arrive, and is tried again."""
    phases = (f"{name},message=initiation", f"{name},message=response")
    return Plan(name, HANDSHAKE, phases, paper=name if on_paper else None)


HANDSHAKE_PLANS: tuple[Plan, ...] = (
    _alter("tamper-key", on_paper=True),
    _alter("replace-key", on_paper=True),
    _alter("random", on_paper=True),
    _alter("invalid-element", on_paper=True),
    _alter("suite-downgrade", on_paper=False),
    _alter("corrupt-share", on_paper=False),
    _alter("alter-indices", on_paper=False),
    _alter("alter-macs", on_paper=False),
    Plan("alter-macs, mac2 under load", HANDSHAKE, (f"alter-macs,mac=mac2,message=initiation {LOAD}",)),
    _alter("splice-handshake", on_paper=False),
    Plan("replay-initiation", HANDSHAKE, ("replay-initiation,copies=20",), "replay-initiation,copies=5", least_s=1.2),
    Plan(
        "replay-initiation, later",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=later,delay_s=1",),
        after_s=1.1,
        is_variant=True,
    ),
    Plan(
        "replay-initiation, after rekey",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=rekey",),
        least_s=3.0,
        is_variant=True,
    ),
    Plan(
        "replay-initiation, after restart",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=restart",),
        restarts=True,
        least_s=3.0,
        is_variant=True,
    ),
    Plan("replay-response", HANDSHAKE, ("replay-response,copies=20",), "replay-response,copies=5", least_s=1.2),
    Plan("replay-cookie", HANDSHAKE, (f"replay-cookie,copies=100 {LOAD}",), restarts=True, least_s=1.5),
    Plan("stolen-cookie", HANDSHAKE, (f"stolen-cookie,copies=20 {LOAD}",), least_s=1.5),
    Plan("forge-cookie", HANDSHAKE, ("forge-cookie,copies=20",), least_s=1.2),
    Plan(
        "reflect handshakes",
        HANDSHAKE,
        ("reflect,kinds=handshake,copies=20",),
        "reflect,kinds=handshake",
        least_s=1.2,
    ),
    Plan("bit-flip handshakes", HANDSHAKE, ("bit-flip,kinds=handshake",), "bit-flip,kinds=handshake"),
    Plan(
        "bit-flip handshakes, mac1 repaired",
        HANDSHAKE,
        ("bit-flip,kinds=handshake,repair_mac1=true",),
        is_variant=True,
    ),
    Plan("truncate handshakes", HANDSHAKE, ("truncate,kinds=handshake",), "truncate,kinds=handshake"),
    Plan("extend handshakes", HANDSHAKE, ("extend,kinds=handshake",), "extend,kinds=handshake"),
    Plan("drop initiations", HANDSHAKE, ("drop-message,message=initiation",), "drop,kinds=initiation"),
    Plan("drop responses", HANDSHAKE, ("drop-message,message=response",), "drop,kinds=response"),
    Plan("drop confirmations", HANDSHAKE, ("drop-message,message=confirmation",), least_s=1.2, is_variant=True),
    Plan("drop cookies", HANDSHAKE, (f"drop-message,message=cookie {LOAD}",), restarts=True, least_s=1.5),
    Plan("block-rekey", HANDSHAKE, ("block-rekey",), "block-rekey"),
    Plan("hold handshakes", HANDSHAKE, ("hold,kinds=handshake,hold_s=0.3",), "hold,kinds=handshake,hold_s=0.1"),
    Plan("roam with handshakes", HANDSHAKE, ("roam,kinds=handshake",), least_s=1.2),
    Plan(
        "cross-initiations",
        HANDSHAKE,
        ("cross-initiations drop-message,message=response,share=0.97",),
        least_s=2.5,
        notes="most responses are dropped as well, so that both sides go on initiating",
    ),
)
"""On a link with new keys each second, and quick retries."""

STALE_PLANS: tuple[Plan, ...] = tuple(
    Plan(
        f"{name}, peer restarted",
        HANDSHAKE,
        (f"{name}{options}",),
        restarts=True,
        least_s=2.0,
        targeted=False,
        is_variant=is_variant,
        notes="no session is left while it lasts; ordinary retry timers",
    )
    for name, options, is_variant in (
        ("tamper-key", "", False),
        ("replace-key", "", True),
        ("random", "", True),
        ("drop-message", ",message=response", True),
        ("block-rekey", "", True),
    )
)
"""On a link with the default timers: what the attack holds up comes back after it."""

DATA_PLANS: tuple[Plan, ...] = (
    Plan("bit-flip", DATA, ("bit-flip,beside=true",), "bit-flip,beside=true"),
    Plan("bit-flip, in place", DATA, ("bit-flip",), "bit-flip", is_variant=True),
    Plan("truncate", DATA, ("truncate,beside=true",), "truncate,beside=true"),
    Plan("extend", DATA, ("extend,beside=true",), "extend,beside=true"),
    Plan("splice", DATA, ("splice,beside=true",), "splice,beside=true"),
    Plan("counter-jump", DATA, ("counter-jump",), "counter-jump"),
    Plan("alter-frame", DATA, ("alter-frame,beside=true",), "alter-frame,beside=true"),
    Plan("alter-frame, in place", DATA, ("alter-frame",), "alter-frame", is_variant=True),
    Plan("tamper-tag", DATA, ("tamper-tag,beside=true",), "tamper-tag,beside=true"),
    Plan("forge-data", DATA, ("forge-data,rate_per_s=1500",), "forge-data,rate_per_s=1500", is_silent=True),
    Plan("raw-mavlink", DATA, ("raw-mavlink,rate_per_s=1500",), "raw-mavlink,rate_per_s=1500", is_silent=True),
    Plan("replay-data", DATA, ("replay-data,copies=2",), "replay-data,copies=2"),
    Plan(
        "replay-data, later",
        DATA,
        ("replay-data,when=later,delay_s=1",),
        "replay-data,when=later,delay_s=1",
        least_s=1.5,
        is_variant=True,
    ),
    Plan("replay-data, after rekey", DATA, ("replay-data,when=rekey,rate_per_s=3000",), least_s=3.0, is_variant=True),
    Plan(
        "replay-data, after restart",
        DATA,
        ("replay-data,when=restart,rate_per_s=3000,copies=24",),
        restarts=True,
        least_s=3.0,
        is_variant=True,
    ),
    Plan("replay-data, from elsewhere", DATA, ("replay-data,origin=stranger",), "replay-data,origin=stranger"),
    Plan("duplicate", DATA, ("duplicate",), "duplicate,kinds=envelope"),
    Plan("reflect", DATA, ("reflect,kinds=envelope",), "reflect,kinds=envelope"),
    Plan(
        "hold",
        DATA,
        ("hold,hold_s=2.6,share=0.5,limit={target}",),
        "hold,hold_s=2.6,share=0.5,limit={target}",
        after_s=2.8,
        takes_away=True,
        notes="longer than anything may take: what is let go is refused as delayed",
    ),
    Plan("reorder", DATA, ("reorder,limit={more}",), "reorder,limit={more}", after_s=3.0),
    Plan("roam, racing", DATA, ("roam",), "roam"),
    Plan("roam, then gone", DATA, ("roam,mode=instead",), "roam,mode=instead", takes_away=True),
)
"""On a link with new keys each two seconds."""

FLOOD_PLANS: tuple[Plan, ...] = (
    Plan(
        "flood-envelopes",
        FLOOD,
        ("flood-envelopes,rate_per_s=3000",),
        "flood-envelopes,rate_per_s=3000",
        is_silent=True,
    ),
    Plan("flood-initiations", FLOOD, ("flood-initiations,rate_per_s=1500",)),
    Plan(
        "flood-initiations, no public key",
        FLOOD,
        ("flood-initiations,mac1=bad,rate_per_s=1500",),
        is_silent=True,
        is_variant=True,
    ),
    Plan("flood-replays", FLOOD, ("flood-replays,rate_per_s=1500",), least_s=1.3),
    Plan("flood-garbage", FLOOD, ("flood-garbage,rate_per_s=1500",), "flood-garbage,rate_per_s=1500", is_silent=True),
    Plan("stranger-scan", FLOOD, ("stranger-scan,rate_per_s=1500",), "stranger-scan,rate_per_s=1500", is_silent=True),
    Plan("amplification-probe", FLOOD, ("amplification-probe,rate_per_s=1500",)),
    Plan("forge-hints", FLOOD, ("forge-hints,rate_per_s=1500",)),
)
"""On the same link as the attacks on data."""

TRAFFIC_PLANS: tuple[Plan, ...] = (
    Plan("drop, half", TRAFFIC, ("drop,share=0.5",), "drop,share=0.5", takes_away=True),
    Plan(
        "drop, one way",
        TRAFFIC,
        ("drop,way=drone0>drone1",),
        "drop,way=drone0>drone1",
        targeted=False,
        least_s=1.0,
        is_variant=True,
    ),
    Plan(
        "drop-heartbeats",
        TRAFFIC,
        ("drop-heartbeats",),
        "drop-heartbeats",
        targeted=False,
        least_s=1.0,
        takes_away=True,
    ),
    Plan(
        "stretch",
        TRAFFIC,
        ("stretch,way=drone0>drone1,interval_s=0.4",),
        "stretch,way=drone0>drone1,interval_s=0.4",
        targeted=False,
        least_s=5.0,
        takes_away=True,
        notes="each envelope is delayed a little more than the one before",
    ),
    Plan(
        "stretch-one-way",
        TRAFFIC,
        ("stretch-one-way,way=drone0>drone1,interval_s=0.4",),
        targeted=False,
        least_s=5.0,
        takes_away=True,
        notes="the same, and the echo records of the other direction are dropped",
    ),
    Plan(
        "blackout, 1 s",
        TRAFFIC,
        ("blackout,seconds=60",),
        "blackout,seconds=60",
        targeted=False,
        least_s=1.0,
        takes_away=True,
    ),
)
"""Between three drones, with new keys each second."""

LONG_PLANS: tuple[Plan, ...] = (
    Plan("blackout, 4 s", TRAFFIC, ("blackout,seconds=60",), targeted=False, least_s=4.0, is_variant=True),
    Plan("blackout, 12 s", TRAFFIC, ("blackout,seconds=60",), targeted=False, least_s=12.0, is_variant=True),
    Plan(
        "blackout, kept and let go",
        TRAFFIC,
        ("hold,kinds=any,hold_s=10,seconds=10",),
        "hold,kinds=any,hold_s=10,seconds=10",
        targeted=False,
        least_s=10.0,
        after_s=10.5,
        is_variant=True,
        notes="nothing passes for ten seconds, then all of it comes, ten seconds old",
    ),
)
"""Likewise, in a full run only."""

LAST_PLANS: tuple[Plan, ...] = (
    Plan("wander", DATA, ("wander",), "wander", validates=True),
    Plan(
        "roam, relaying",
        DATA,
        ("roam,mode=relay",),
        "roam,mode=relay",
        validates=True,
        targeted=False,
        least_s=2.0,
        is_variant=True,
    ),
)
"""They prove addresses of the attacker's own, so they come after what counts bytes to such addresses."""

MISROUTE_PLANS: tuple[Plan, ...] = (
    Plan("misroute", DATA, ("misroute,kinds=envelope",)),
    Plan("misroute handshakes", HANDSHAKE, ("misroute,kinds=handshake,copies=20",), least_s=1.2),
)
"""Between three drones."""
