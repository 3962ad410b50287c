"""The plans of the tampering evaluation: every attack of the man in the middle, in several variants.

The *phases* of a plan run one after another; each is a line of attacks for the man in the middle. The first in a line
is the attack, the others help it (for example a flood, so that daemons require cookies).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from uavlinkd.lab.evaluation.frame import EvaluationSettings
from uavlinkd.lab.evaluation.tampering_records import PAPER
from uavlinkd.protocol.constants import QUESTION_LIFETIME_S

HANDSHAKE, DATA, FLOOD, TRAFFIC, KEYS = "handshake", "data", "flood", "traffic", "keys"
PATHS, LINE, RELAYED, WEB, FLEET = "paths", "line", "relay", "web", "fleet"
_SHORT_GROUPS: Final = (HANDSHAKE, KEYS, FLEET)
LOAD: Final = "flood-initiations,rate_per_s=600"
"""The load at which daemons require cookies."""


@dataclass(frozen=True, slots=True)
class TamperingSettings(EvaluationSettings):
    """The extent of the evaluation."""

    only: tuple[str, ...] = ()
    """The stages that run; empty: all of them."""

    @property
    def rate_hz(self) -> float:
        """Frames per second of each client on a stage for attacks on data."""
        return 100.0 if self.quick else 250.0

    def target(self, group: str, system: str) -> int:
        """The number of attempts of an attack. On the paper's protocol a tenth is sufficient."""
        if self.quick:
            return 5 if group in _SHORT_GROUPS else 60
        wanted = 200 if group in _SHORT_GROUPS else 10_000
        return wanted // 10 if system == PAPER else wanted

    def most_s(self, group: str) -> float:
        if self.quick:
            return 8.0
        return 300.0 if group in _SHORT_GROUPS else 60.0


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


def plan_rows(group: str, table: str, **common: bool | float | str) -> tuple[TrialPlan, ...]:
    """The plans in a table: attack, line of attacks (by default the attack's name), and what differs from ``common``.

    ``-NAME`` is false. ``paper=same``: the same line on the paper's protocol; ``paper=none``: there is none. An
    indented line continues the row before it.
    """
    plans = []
    for row in table.strip().replace("\n    ", " ").splitlines():
        for short, meaning in _SHORT.items():
            row = row.replace(short, meaning)  # noqa: PLW2901  the same row
        attack, line, words, *_ = (*(part.strip() for part in row.split("|")), "", "")
        facts: dict[str, Any] = {"paper": "none", **common}
        facts |= dict(_fact(word) for word in words.split())
        facts["paper"] = {"none": None, "same": line or attack}.get(facts["paper"], facts["paper"])
        plans.append(TrialPlan(attack, group, (line or attack,), **facts))
    return tuple(plans)


def _fact(word: str) -> tuple[str, object]:
    name, _, value = word.partition("=")
    if name == "paper":
        return name, value
    if name == "needs":
        return name, tuple(value.split(","))
    return (name, float(value)) if value else (name.removeprefix("-"), not name.startswith("-"))


_SHORT: Final = {"<load>": LOAD, "<first>": "direction=both/1", "<question>": str(QUESTION_LIFETIME_S)}

HANDSHAKE_PLANS: Final = (
    # Alterations of both messages in place: the genuine message is lost, and the peer retries.
    *(
        TrialPlan(name, HANDSHAKE, (f"{name},message=initiation", f"{name},message=response"), paper)
        for names, has_paper in (
            (("tamper-key", "replace-key", "random", "invalid-element"), True),
            (("suite-downgrade", "corrupt-share", "alter-indices", "alter-macs"), False),
        )
        for name in names
        for paper in ([name] if has_paper else [None])
    ),
    *plan_rows(
        HANDSHAKE,
        """
alter-macs, mac2 under load | alter-macs,mac=mac2,message=initiation <load>
replay-initiation | replay-initiation,copies=20 | paper=replay-initiation,copies=5 least_s=1.2
replay-initiation, later | replay-initiation,copies=20,when=later,delay_s=1 | after_s=1.1 is_variant
replay-initiation, after rekey | replay-initiation,copies=20,when=rekey | least_s=3 is_variant
replay-initiation, after restart | replay-initiation,copies=20,when=restart | restarts least_s=3 is_variant
replay-response | replay-response,copies=20 | paper=replay-response,copies=5 least_s=1.2
replay-cookie | replay-cookie,copies=100 <load> | restarts least_s=1.5
stolen-cookie | stolen-cookie,copies=20 <load> | least_s=1.5
forge-cookie | forge-cookie,copies=20 | least_s=1.2
reflect handshakes | reflect,kinds=handshake,copies=20 | paper=reflect,kinds=handshake least_s=1.2
bit-flip handshakes | bit-flip,kinds=handshake | paper=same
truncate handshakes | truncate,kinds=handshake | paper=same
extend handshakes | extend,kinds=handshake | paper=same
bit-flip handshakes, mac1 repaired | bit-flip,kinds=handshake,repair_mac1=true | is_variant
drop initiations | drop-message,message=initiation | paper=drop,kinds=initiation
drop responses | drop-message,message=response | paper=drop,kinds=response
drop confirmations | drop-message,message=confirmation | least_s=1.2 is_variant
drop cookies | drop-message,message=cookie <load> | restarts least_s=1.5
block-rekey |  | paper=same
hold handshakes | hold,kinds=handshake,hold_s=0.3 | paper=hold,kinds=handshake,hold_s=0.1
roam with handshakes | roam,kinds=handshake | least_s=1.2
cross-initiations | cross-initiations drop-message,message=response,share=0.97 | least_s=2.5
""",
    ),
)
"""On a link with a rekey per second and fast retries. With cross-initiations, most responses are dropped too, so that
both peers continue to initiate."""

STALE_PLANS: Final = plan_rows(
    HANDSHAKE,
    """
tamper-key, peer restarted | tamper-key | -is_variant
replace-key, peer restarted | replace-key
drop-message, peer restarted | drop-message,message=response
block-rekey, peer restarted | block-rekey
""",
    restarts=True,
    least_s=2.0,
    targeted=False,
    is_variant=True,
)
"""Without a session during the attack, on a link with the default timers: the link recovers after the attack."""

DATA_PLANS: Final = plan_rows(
    DATA,
    """
bit-flip | bit-flip,beside=true
truncate | truncate,beside=true
extend | extend,beside=true
splice | splice,beside=true
alter-frame | alter-frame,beside=true
tamper-tag | tamper-tag,beside=true
bit-flip, in place | bit-flip | is_variant
alter-frame, in place | alter-frame | is_variant
counter-jump
forge-data | forge-data,rate_per_s=1500 | is_silent
raw-mavlink | raw-mavlink,rate_per_s=1500 | is_silent
replay-data | replay-data,copies=2
replay-data, later | replay-data,when=later,delay_s=1 | least_s=1.5 is_variant
replay-data, after rekey | replay-data,when=rekey,rate_per_s=3000 | paper=none least_s=3 is_variant
replay-data, after restart | replay-data,when=restart,rate_per_s=3000,copies=24
    | paper=none restarts least_s=3 is_variant
replay-data, from elsewhere | replay-data,origin=stranger
duplicate |  | paper=duplicate,kinds=envelope
reflect | reflect,kinds=envelope
hold | hold,hold_s=2.6,share=0.5,limit={target} | after_s=2.8 takes_away
reorder | reorder,limit={more} | after_s=3
roam, racing | roam
roam, then gone | roam,mode=instead | noticed_after_s=<question> takes_away needs=paths_unproven
""",
    paper="same",
)
"""On a link with a rekey every two seconds. What is held is refused as delayed when it is released."""

FLOOD_PLANS: Final = plan_rows(
    FLOOD,
    """
flood-envelopes | flood-envelopes,rate_per_s=3000 | paper=same is_silent
flood-initiations | flood-initiations,rate_per_s=1500
flood-initiations, no public key | flood-initiations,mac1=bad,rate_per_s=1500 | is_silent is_variant
flood-garbage | flood-garbage,rate_per_s=1500 | paper=same is_silent
amplification-probe | amplification-probe,rate_per_s=1500
forge-hints | forge-hints,rate_per_s=1500
""",
)
"""On the same link as the attacks on data."""

TRAFFIC_PLANS: Final = plan_rows(
    TRAFFIC,
    """
drop, half | drop,share=0.5 | least_s=0.3 targeted takes_away
drop, one way | drop,direction=drone0>drone1 | is_variant
drop-heartbeats |  | paper=drop-heartbeats,size=58 takes_away needs=envelopes_missing
stretch | stretch,direction=drone0>drone1,interval_s=0.4 | least_s=5 takes_away
stretch-one-way | stretch-one-way,direction=drone0>drone1,interval_s=0.4 | paper=none least_s=5 takes_away
blackout, 1 s | blackout,seconds=60 | takes_away needs=envelopes_missing
blackout, 12 s | blackout,seconds=60 | paper=none least_s=12 is_variant
blackout, kept and let go | hold,kinds=any,hold_s=10,seconds=10 | least_s=10 after_s=10.5 is_variant
""",
    paper="same",
    targeted=False,
    least_s=1.0,
)
"""Between three drones, with a rekey per second. In ``stretch`` the delay grows with each envelope; one way, the echo
records of the other direction are dropped. The paper's tag of 32 bytes makes its heartbeats 58 bytes long."""

LAST_PLANS: Final = plan_rows(
    DATA,
    """
wander
roam, relaying | roam,mode=relay | least_s=2 -targeted is_variant
""",
    paper="same",
    validates=True,
)
"""They validate strangers, so they run after the attacks that count bytes to strangers."""

MISROUTE_PLANS: Final = (
    *plan_rows(DATA, "misroute | misroute,kinds=envelope"),
    *plan_rows(HANDSHAKE, "misroute handshakes | misroute,kinds=handshake,copies=20 | least_s=1.2"),
)

PAPER_PLANS: Final = tuple(
    plan
    for rows in (HANDSHAKE_PLANS, DATA_PLANS, FLOOD_PLANS, TRAFFIC_PLANS, LAST_PLANS)
    for plan in rows
    if plan.paper is not None
)

_ON_PATHS: Final[dict[str, Any]] = {"takes_away": True, "keeps_link": True, "targeted": False}

PATH_PLANS: Final = plan_rows(
    PATHS,
    """
copies on the other path | replay-data,<first>,onto=2 | least_s=0.3 targeted -is_variant needs=duplicate
copies on the other path, after 10 s | replay-data,<first>,onto=2,when=later,delay_s=10
    | least_s=0.3 targeted needs=late_copy
moved to the other path | move,<first>,onto=2 | least_s=3 -is_variant needs=unexpected_answer
one path dropped | drop,<first> | least_s=3 -is_variant needs=path_changed
one path slowed | hold,kinds=any,<first>,hold_s=0.2 | needs=path_changed
frames dropped, probes pass | drop,kinds=frames,<first> | least_s=5 -is_variant needs=path_changed
frames delayed, probes pass | hold,kinds=frames,<first>,hold_s=3 | after_s=3.5 needs=path_changed,delayed
frames replaced by those of the other path | drop,kinds=frames,<first> move,direction=both/2,onto=1,beside=true
    | needs=unexpected_answer
one path held and let go | hold,kinds=any,<first>,hold_s=10,at_once=true,seconds=10
    | least_s=10 after_s=2 needs=path_changed,late_copy
probes copied to the other path | duplicate,kinds=probe,<first>,onto=2 | least_s=3 -is_variant needs=duplicate
probes replayed later | duplicate,kinds=probe,<first>,when=later,delay_s=1 | needs=duplicate
bit-flip probes | bit-flip,kinds=probe,<first> | least_s=3 -is_variant needs=bad_tag
responses dropped on one path | drop-message,message=response,<first> | needs=handshakes_unanswered
roam on one path, racing | roam,<first> | needs=duplicate,paths_unproven
roam on one path, then gone | roam,<first>,mode=instead | noticed_after_s=<question> needs=paths_unproven
many spoofed sources | wander,mode=race | least_s=3 -is_variant needs=paths_unproven
many relayed sources | wander,<first> | validates needs=paths_unproven
roam on one path, relaying | roam,<first>,mode=relay | validates needs=path_changed
""",
    # A path that is down gets copies for 10 s after its last answer: longer attacks show what happens then.
    least_s=14.0,
    is_variant=True,
    **_ON_PATHS,
)
"""The first path is the faster one, so it is the best when an attack begins. The last rows validate strangers."""

LINE_PLANS: Final = plan_rows(
    LINE,
    """
bytes injected on the line | line-noise,interval_s=0.1 | needs=line_noise
line frames with one altered byte | line-bad-crc,interval_s=0.025 | needs=line_noise
line frames cut at every offset | line-cut,interval_s=0.1 | needs=line_noise
datagrams replayed on the line | line-replay,interval_s=0.025 | needs=duplicate
datagrams forged on the line | line-forge,interval_s=0.025 | needs=bad_tag,unknown_index
line held for 3 s and let go | line-hold,hold_s=3,interval_s=1000,end=both | least_s=3 after_s=3 -targeted
line held for 10 s and let go | line-hold,hold_s=10,interval_s=1000,end=both
    | least_s=10 after_s=3 -targeted is_variant needs=peer_lost
line held for 10 s in one direction | line-hold,hold_s=10,interval_s=1000,end=right
    | least_s=10 after_s=3 -targeted is_variant
""",
    takes_away=True,
)
"""On a serial line, with a rekey every ten seconds. The first three add no whole datagram to the recorded ones, from
which the fourth one selects."""

RELAYED_PLANS: Final = plan_rows(
    RELAYED,
    """
relay drops half | drop,kinds=any,share=0.5 | needs=envelopes_missing
relay drops everything for 1 s | blackout,seconds=60 | least_s=1 -targeted
relay drops everything for 14 s | blackout,seconds=60 | least_s=14 -targeted is_variant needs=peer_lost
relay delays by 3 s | hold,hold_s=3,share=0.5,limit={target} | after_s=3.2 needs=delayed
relay duplicates | duplicate | needs=duplicate
relay reorders | reorder,limit={more} | after_s=3 needs=envelopes_out_of_order
relay misdelivers envelopes | misroute,kinds=envelope | needs=unknown_index
relay misdelivers handshakes | misroute,kinds=handshake,copies=100 | least_s=3 needs=bad_mac1
relay alters | bit-flip,beside=true | needs=bad_tag
relay forges | forge-data,rate_per_s=1500 | needs=bad_tag
relay replays | replay-data,copies=2 | needs=duplicate
relay replays later | replay-data,when=later,delay_s=3 | least_s=4 is_variant
relay replays after a member's restart | replay-data,when=restart,rate_per_s=3000,copies=24
    | restarts least_s=3 -targeted is_variant
relay lies about addresses | relay-lie,rate_per_s=100 | is_silent
relay invents handles | relay-invent | least_s=3 needs=relay_unknown_handle,relay_malformed
relay sends frames of its own | relay-frames,rate_per_s=100 | needs=frames_not_allowed
relay binds the wrong members | relay-bind-wrong,rate_per_s=100 | least_s=5 needs=unknown_index
""",
    takes_away=True,
)
"""On three daemons that reach each other only along a hostile relay. The last one leaves gaps in the counters, which
the daemons report later."""

WEB_PLANS: Final = plan_rows(
    WEB,
    """
proxy alters messages | bit-flip,beside=true | needs=bad_tag
proxy cuts messages | truncate,beside=true | needs=malformed
proxy joins messages | splice,beside=true | needs=bad_tag
proxy forges messages | forge-data,rate_per_s=1000 | needs=bad_tag
proxy replays | replay-data,copies=2 | needs=duplicate
proxy replays later | replay-data,when=later,delay_s=3 | least_s=4 is_variant needs=late_copy
proxy delays by 3 s | hold,hold_s=3,share=0.5,limit={target} | after_s=3.2 needs=delayed
proxy reorders | reorder,limit={more} | after_s=3 needs=envelopes_out_of_order
proxy answers for the relay | reflect,kinds=any | needs=unknown_index
proxy drops half | drop,kinds=any,share=0.5 | needs=envelopes_missing
proxy keeps the connection and drops everything | blackout,seconds=60
    | least_s=25 -targeted is_variant needs=relay_disconnected
proxy puts garbage between messages | web-garbage,rate_per_s=1 | least_s=3 -targeted needs=relay_connected
proxy splits messages | web-fragment,rate_per_s=1 | least_s=3 -targeted needs=relay_connected
proxy floods with pings | web-pings,rate_per_s=1 | least_s=3 -targeted needs=relay_connected
proxy resets connections | web-reset,rate_per_s=1 | least_s=3 -targeted needs=envelopes_missing
""",
    takes_away=True,
)
"""On two daemons that reach each other only along an honest relay, by TLS. A hostile proxy ends the TLS of the first
one. What only a stream has costs the connection, and the member connects again."""

_UNANSWERED: Final = "drop-message,message=response"
"""A daemon that starts shows its certificate until it is answered."""

FLEET_PLANS: Final = plan_rows(
    FLEET,
    f"""
initiations with certificates replayed | replay-initiation,kinds=certificate,copies=20 {_UNANSWERED}
    | restarts needs=duplicate
initiations with certificates replayed later
    | replay-initiation,kinds=certificate,copies=20,when=later,delay_s=12 {_UNANSWERED}
    | restarts is_variant after_s=12.1 needs=duplicate
initiations with certificates truncated | truncate,kinds=certificate | restarts needs=malformed
initiations with certificates extended | extend,kinds=certificate | restarts needs=malformed
certificates cut off and added | certificate-length {_UNANSWERED} | restarts needs=bad_handshake
records replayed | replay-data,kinds=record,copies=20 | restarts needs=duplicate
flood of the length of certificates | flood-initiations,certificate=true,rate_per_s=1500 | needs=bad_handshake
""",
    least_s=3.0,
    takes_away=True,
)
"""On two members by certificate. The second one has the first as its contact. The first one has forgotten it after a
restart of both."""
