"""The plans of the tampering evaluation: every attack of the man in the middle, in several variants.

The *phases* of a plan run one after another; each is a line of attacks for the man in the middle. The first in a line
is the attack, the others help it (for example a flood, so that daemons require cookies).
"""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.core.constants import QUESTION_LIFETIME_S

HANDSHAKE, DATA, FLOOD, TRAFFIC, KEYS = "handshake", "data", "flood", "traffic", "keys"
STAGES = ("handshake", "data", "keys", "member", "paper", "reports", "paths", "line", "relay")
"""What a run may be limited to. Each has its own daemons."""
LOAD = "flood-initiations,rate_per_s=600"
"""The load at which daemons require cookies."""


@dataclass(frozen=True, slots=True)
class TrialPlan:
    """One row of the table."""

    attack: str
    group: str
    phases: tuple[str, ...]
    paper: str | None = None
    """The same attack on the paper's protocol; None if that has no target. As in the phases, ``{target}`` is the
    number of attempts, ``{more}`` a fifth more."""
    restarts: bool = False
    """A drone is killed and restarted during the attack."""
    is_silent: bool = False
    """The attack knows no public key, so strangers must not get an answer."""
    validates: bool = False
    """Its strangers relay answers and so become validated addresses: they may receive more than they sent."""
    least_s: float = 0.3
    """The minimum duration."""
    after_s: float = 0.0
    """How long it continues after the last attempt, to release held datagrams."""
    targeted: bool = True
    """Whether it ends after a number of attempts; otherwise after a time."""
    noticed_after_s: float = 0.0
    """How long after its end the drones may still count it."""
    takes_away: bool = False
    """Envelopes are missing, reordered or come from elsewhere: the drones count them later."""
    keeps_link: bool = False
    """A path that it does not attack works: then the link must stay up, and no critical frame may be lost."""
    needs: tuple[str, ...] = ()
    """Counters that must grow, or events that must be in the log."""
    is_variant: bool = False
    """Omitted in a quick run, which has another row of the same attack."""
    notes: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the attacks whose interventions are attempts: the first of each phase."""
        return tuple(dict.fromkeys(phase.split()[0].split(",")[0] for phase in self.phases))


def with_target(phase: str, target: int) -> str:
    """The line for the man in the middle, with the number of attempts."""
    return phase.replace("{target}", str(target)).replace("{more}", str(target + target // 5))


def _alter(name: str, *, on_paper: bool) -> TrialPlan:
    """An alteration in place: the genuine message is lost, and the peer retries."""
    phases = (f"{name},message=initiation", f"{name},message=response")
    return TrialPlan(name, HANDSHAKE, phases, paper=name if on_paper else None)


HANDSHAKE_PLANS: tuple[TrialPlan, ...] = (
    _alter("tamper-key", on_paper=True),
    _alter("replace-key", on_paper=True),
    _alter("random", on_paper=True),
    _alter("invalid-element", on_paper=True),
    _alter("suite-downgrade", on_paper=False),
    _alter("corrupt-share", on_paper=False),
    _alter("alter-indices", on_paper=False),
    _alter("alter-macs", on_paper=False),
    TrialPlan("alter-macs, mac2 under load", HANDSHAKE, (f"alter-macs,mac=mac2,message=initiation {LOAD}",)),
    _alter("splice-handshake", on_paper=False),
    TrialPlan(
        "replay-initiation", HANDSHAKE, ("replay-initiation,copies=20",), "replay-initiation,copies=5", least_s=1.2
    ),
    TrialPlan(
        "replay-initiation, later",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=later,delay_s=1",),
        after_s=1.1,
        is_variant=True,
    ),
    TrialPlan(
        "replay-initiation, after rekey",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=rekey",),
        least_s=3.0,
        is_variant=True,
    ),
    TrialPlan(
        "replay-initiation, after restart",
        HANDSHAKE,
        ("replay-initiation,copies=20,when=restart",),
        restarts=True,
        least_s=3.0,
        is_variant=True,
    ),
    TrialPlan("replay-response", HANDSHAKE, ("replay-response,copies=20",), "replay-response,copies=5", least_s=1.2),
    TrialPlan("replay-cookie", HANDSHAKE, (f"replay-cookie,copies=100 {LOAD}",), restarts=True, least_s=1.5),
    TrialPlan("stolen-cookie", HANDSHAKE, (f"stolen-cookie,copies=20 {LOAD}",), least_s=1.5),
    TrialPlan("forge-cookie", HANDSHAKE, ("forge-cookie,copies=20",), least_s=1.2),
    TrialPlan(
        "reflect handshakes",
        HANDSHAKE,
        ("reflect,kinds=handshake,copies=20",),
        "reflect,kinds=handshake",
        least_s=1.2,
    ),
    TrialPlan("bit-flip handshakes", HANDSHAKE, ("bit-flip,kinds=handshake",), "bit-flip,kinds=handshake"),
    TrialPlan(
        "bit-flip handshakes, mac1 repaired",
        HANDSHAKE,
        ("bit-flip,kinds=handshake,repair_mac1=true",),
        is_variant=True,
    ),
    TrialPlan("truncate handshakes", HANDSHAKE, ("truncate,kinds=handshake",), "truncate,kinds=handshake"),
    TrialPlan("extend handshakes", HANDSHAKE, ("extend,kinds=handshake",), "extend,kinds=handshake"),
    TrialPlan("drop initiations", HANDSHAKE, ("drop-message,message=initiation",), "drop,kinds=initiation"),
    TrialPlan("drop responses", HANDSHAKE, ("drop-message,message=response",), "drop,kinds=response"),
    TrialPlan("drop confirmations", HANDSHAKE, ("drop-message,message=confirmation",), least_s=1.2, is_variant=True),
    TrialPlan("drop cookies", HANDSHAKE, (f"drop-message,message=cookie {LOAD}",), restarts=True, least_s=1.5),
    TrialPlan("block-rekey", HANDSHAKE, ("block-rekey",), "block-rekey"),
    TrialPlan("hold handshakes", HANDSHAKE, ("hold,kinds=handshake,hold_s=0.3",), "hold,kinds=handshake,hold_s=0.1"),
    TrialPlan("roam with handshakes", HANDSHAKE, ("roam,kinds=handshake",), least_s=1.2),
    TrialPlan(
        "cross-initiations",
        HANDSHAKE,
        ("cross-initiations drop-message,message=response,share=0.97",),
        least_s=2.5,
        notes="most responses are dropped too, so that both peers continue to initiate",
    ),
)
"""On a link with a rekey per second and fast retries."""

STALE_PLANS: tuple[TrialPlan, ...] = tuple(
    TrialPlan(
        f"{name}, peer restarted",
        HANDSHAKE,
        (f"{name}{options}",),
        restarts=True,
        least_s=2.0,
        targeted=False,
        is_variant=is_variant,
        notes="without a session during the attack; default retry timers",
    )
    for name, options, is_variant in (
        ("tamper-key", "", False),
        ("replace-key", "", True),
        ("random", "", True),
        ("drop-message", ",message=response", True),
        ("block-rekey", "", True),
    )
)
"""On a link with the default timers: the link recovers after the attack."""

DATA_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan("bit-flip", DATA, ("bit-flip,beside=true",), "bit-flip,beside=true"),
    TrialPlan("bit-flip, in place", DATA, ("bit-flip",), "bit-flip", is_variant=True),
    TrialPlan("truncate", DATA, ("truncate,beside=true",), "truncate,beside=true"),
    TrialPlan("extend", DATA, ("extend,beside=true",), "extend,beside=true"),
    TrialPlan("splice", DATA, ("splice,beside=true",), "splice,beside=true"),
    TrialPlan("counter-jump", DATA, ("counter-jump",), "counter-jump"),
    TrialPlan("alter-frame", DATA, ("alter-frame,beside=true",), "alter-frame,beside=true"),
    TrialPlan("alter-frame, in place", DATA, ("alter-frame",), "alter-frame", is_variant=True),
    TrialPlan("tamper-tag", DATA, ("tamper-tag,beside=true",), "tamper-tag,beside=true"),
    TrialPlan("forge-data", DATA, ("forge-data,rate_per_s=1500",), "forge-data,rate_per_s=1500", is_silent=True),
    TrialPlan("raw-mavlink", DATA, ("raw-mavlink,rate_per_s=1500",), "raw-mavlink,rate_per_s=1500", is_silent=True),
    TrialPlan("replay-data", DATA, ("replay-data,copies=2",), "replay-data,copies=2"),
    TrialPlan(
        "replay-data, later",
        DATA,
        ("replay-data,when=later,delay_s=1",),
        "replay-data,when=later,delay_s=1",
        least_s=1.5,
        is_variant=True,
    ),
    TrialPlan(
        "replay-data, after rekey", DATA, ("replay-data,when=rekey,rate_per_s=3000",), least_s=3.0, is_variant=True
    ),
    TrialPlan(
        "replay-data, after restart",
        DATA,
        ("replay-data,when=restart,rate_per_s=3000,copies=24",),
        restarts=True,
        least_s=3.0,
        is_variant=True,
    ),
    TrialPlan("replay-data, from elsewhere", DATA, ("replay-data,origin=stranger",), "replay-data,origin=stranger"),
    TrialPlan("duplicate", DATA, ("duplicate",), "duplicate,kinds=envelope"),
    TrialPlan("reflect", DATA, ("reflect,kinds=envelope",), "reflect,kinds=envelope"),
    TrialPlan(
        "hold",
        DATA,
        ("hold,hold_s=2.6,share=0.5,limit={target}",),
        "hold,hold_s=2.6,share=0.5,limit={target}",
        after_s=2.8,
        takes_away=True,
        notes="longer than the maximum delay: released frames are refused as delayed",
    ),
    TrialPlan("reorder", DATA, ("reorder,limit={more}",), "reorder,limit={more}", after_s=3.0),
    TrialPlan("roam, racing", DATA, ("roam",), "roam"),
    TrialPlan(
        "roam, then gone",
        DATA,
        ("roam,mode=instead",),
        "roam,mode=instead",
        noticed_after_s=QUESTION_LIFETIME_S,
        needs=("paths_unproven",),
        takes_away=True,
    ),
)
"""On a link with a rekey every two seconds."""

REPORT_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan(
        "bit-flip reports",
        DATA,
        ("bit-flip,kinds=report,beside=true",),
        targeted=False,
        least_s=5.0,
        notes="refusal reports, one in 2 s: each claim that a drone shows is compared with the refused frames",
    ),
    TrialPlan("duplicate reports", DATA, ("duplicate,kinds=report",), targeted=False, least_s=5.0, is_variant=True),
    TrialPlan(
        "drop reports",
        DATA,
        ("drop,kinds=report",),
        targeted=False,
        least_s=5.0,
        takes_away=True,
        is_variant=True,
        notes="a reason is hidden; frames are not affected",
    ),
)
"""On a link whose ends refuse frames of each other, and report them."""

FLOOD_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan(
        "flood-envelopes",
        FLOOD,
        ("flood-envelopes,rate_per_s=3000",),
        "flood-envelopes,rate_per_s=3000",
        is_silent=True,
    ),
    TrialPlan("flood-initiations", FLOOD, ("flood-initiations,rate_per_s=1500",)),
    TrialPlan(
        "flood-initiations, no public key",
        FLOOD,
        ("flood-initiations,mac1=bad,rate_per_s=1500",),
        is_silent=True,
        is_variant=True,
    ),
    TrialPlan("flood-replays", FLOOD, ("flood-replays,rate_per_s=1500",), least_s=1.3),
    TrialPlan(
        "flood-garbage", FLOOD, ("flood-garbage,rate_per_s=1500",), "flood-garbage,rate_per_s=1500", is_silent=True
    ),
    TrialPlan(
        "stranger-scan", FLOOD, ("stranger-scan,rate_per_s=1500",), "stranger-scan,rate_per_s=1500", is_silent=True
    ),
    TrialPlan("amplification-probe", FLOOD, ("amplification-probe,rate_per_s=1500",)),
    TrialPlan("forge-hints", FLOOD, ("forge-hints,rate_per_s=1500",)),
)
"""On the same link as the attacks on data."""

TRAFFIC_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan("drop, half", TRAFFIC, ("drop,share=0.5",), "drop,share=0.5", takes_away=True),
    TrialPlan(
        "drop, one way",
        TRAFFIC,
        ("drop,direction=drone0>drone1",),
        "drop,direction=drone0>drone1",
        targeted=False,
        least_s=1.0,
        is_variant=True,
    ),
    TrialPlan(
        "drop-heartbeats",
        TRAFFIC,
        ("drop-heartbeats",),
        "drop-heartbeats",
        targeted=False,
        least_s=1.0,
        takes_away=True,
        needs=("envelopes_missing",),
    ),
    TrialPlan(
        "stretch",
        TRAFFIC,
        ("stretch,direction=drone0>drone1,interval_s=0.4",),
        "stretch,direction=drone0>drone1,interval_s=0.4",
        targeted=False,
        least_s=5.0,
        takes_away=True,
        notes="the delay grows with each envelope",
    ),
    TrialPlan(
        "stretch-one-way",
        TRAFFIC,
        ("stretch-one-way,direction=drone0>drone1,interval_s=0.4",),
        targeted=False,
        least_s=5.0,
        takes_away=True,
        notes="the same, and the echo records of the other direction are dropped",
    ),
    TrialPlan(
        "blackout, 1 s",
        TRAFFIC,
        ("blackout,seconds=60",),
        "blackout,seconds=60",
        targeted=False,
        least_s=1.0,
        takes_away=True,
        needs=("envelopes_missing",),
    ),
)
"""Between three drones, with a rekey per second."""

LONG_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan("blackout, 4 s", TRAFFIC, ("blackout,seconds=60",), targeted=False, least_s=4.0, is_variant=True),
    TrialPlan("blackout, 12 s", TRAFFIC, ("blackout,seconds=60",), targeted=False, least_s=12.0, is_variant=True),
    TrialPlan(
        "blackout, kept and let go",
        TRAFFIC,
        ("hold,kinds=any,hold_s=10,seconds=10",),
        "hold,kinds=any,hold_s=10,seconds=10",
        targeted=False,
        least_s=10.0,
        after_s=10.5,
        is_variant=True,
        notes="all datagrams are held for 10 s, then released",
    ),
)
"""Likewise, only in a full run."""

LAST_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan("wander", DATA, ("wander",), "wander", validates=True),
    TrialPlan(
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
"""They validate strangers, so they run after the attacks that count bytes to strangers."""

MISROUTE_PLANS: tuple[TrialPlan, ...] = (
    TrialPlan("misroute", DATA, ("misroute,kinds=envelope",)),
    TrialPlan("misroute handshakes", HANDSHAKE, ("misroute,kinds=handshake,copies=20",), least_s=1.2),
)
"""Between three drones."""
