"""Attacks on a pair with two paths: no critical frame is lost, and the link stays up while one path works.

The simulated network checks at every delivery that the frame was sent, is unaltered, and is delivered once.
"""

from __future__ import annotations

import pytest

from tests.lab.mitm.two_paths import CRITICAL_S, TwoPaths
from uavlinkd.core.constants import LATE_AFTER_S
from uavlinkd.lab.evaluation.ledger import IN_TIME_S
from uavlinkd.lab.evaluation.tampering_plan import SPOILED_PLANS

pytestmark = pytest.mark.long

LASTING_S = 14.0
"""Longer than a path that is down still gets copies."""

# The line of attacks, and what must be counted. "path_changed" is an event.
ATTACKS: dict[str, tuple[str, set[str]]] = {
    "copies at once": ("replay-data,direction=both/1,onto=2", {"duplicate"}),
    "copies after 3 s": ("replay-data,direction=both/1,onto=2,when=later,delay_s=3", {"late_copy"}),
    "copies after 10 s": ("replay-data,direction=both/1,onto=2,when=later,delay_s=10", {"late_copy"}),
    "moved": ("move,direction=both/1,onto=2", {"unexpected_answer"}),
    "dropped": ("drop,direction=both/1", {"path_changed"}),
    "slowed": ("hold,kinds=any,direction=both/1,hold_s=0.2", {"path_changed"}),
    "the other one slowed": ("hold,kinds=any,direction=both/2,hold_s=0.2", {"duplicate"}),
    "frames dropped": ("drop,kinds=frames,direction=both/1", {"path_changed"}),
    "frames delayed": ("hold,kinds=frames,direction=both/1,hold_s=3", {"path_changed", "delayed"}),
    "frames replaced": (
        "drop,kinds=frames,direction=both/1 move,direction=both/2,onto=1,beside=true",
        {"unexpected_answer"},
    ),
    "held": ("hold,kinds=any,direction=both/1,hold_s=10,at_once=true", {"path_changed", "late_copy", "delayed"}),
    "probes copied": ("duplicate,kinds=probe,direction=both/1,onto=2", {"duplicate"}),
    "probes faster along the other": ("move,kinds=probe,direction=both/2,onto=1,beside=true", {"unexpected_answer"}),
    "probes later": ("duplicate,kinds=probe,direction=both/1,when=later,delay_s=1", {"duplicate"}),
    "probes altered": ("bit-flip,kinds=probe,direction=both/1", {"bad_tag", "path_changed"}),
    "racing": ("roam,direction=both/1", {"duplicate", "paths_unproven"}),
    "from elsewhere": ("roam,direction=both/1,mode=instead", {"paths_unproven"}),
    "relayed": ("roam,direction=both/1,mode=relay", {"path_changed"}),
    "spoofed sources": ("wander,mode=race", {"paths_unproven"}),
    "relayed sources": ("wander,direction=both/1", {"paths_unproven"}),
}
RELAYS = {"relayed", "relayed sources"}
"""Their strangers become validated addresses."""


@pytest.mark.parametrize("learns", [False, True], ids=["configured", "learned"])
@pytest.mark.parametrize("name", ATTACKS)
def test_no_critical_frame_is_lost_while_one_path_works(name: str, learns: bool) -> None:
    """For 14 s; then both sides come back to the faster path within seconds."""
    line, counts = ATTACKS[name]
    pair = TwoPaths(name, learns=learns)
    assert pair.numbers_of_best() == {1}
    made = pair.attack(line, LASTING_S)
    assert made[0].attempts > 0
    pair.network.run(4.0)

    assert pair.lost(pair.critical) == 0
    assert pair.longest_gap_s(pair.critical) < 1.5 * CRITICAL_S + 0.2
    assert pair.stayed_up
    seen = {*pair.counted, *(["path_changed"] if pair.changes() else [])}
    assert counts <= seen
    assert max(flow.oldest_s for flow in (*pair.stream, *pair.critical)) < LATE_AFTER_S + 0.75
    if name not in RELAYS:
        assert pair.amplified() == []
    assert all(flow.first_delivery(pair.ended_at) - pair.ended_at < 1.0 for flow in pair.stream)


@pytest.mark.parametrize("learns", [False, True], ids=["configured", "learned"])
def test_critical_frames_arrive_in_time_once_one_of_two_spoiled_paths_works(learns: bool) -> None:
    """The other one was the best path until then, and holds everything from then on."""
    (plan,) = SPOILED_PLANS
    pair = TwoPaths("spoiled", learns=learns, streams=False)
    pair.attack(plan.phases[0], plan.least_s, spoils_s=plan.spoils_s)
    pair.network.run(4.0)
    assert pair.lost(pair.critical) == 0
    assert pair.longest_gap_s(pair.critical) < CRITICAL_S + IN_TIME_S
    assert pair.stayed_up


@pytest.mark.parametrize("learns", [False, True], ids=["configured", "learned"])
def test_responses_dropped_on_the_fastest_path_do_not_prevent_a_session(learns: bool) -> None:
    """From the first initiation on: the response along the other path makes the session."""
    pair = TwoPaths("responses", learns=learns, starts=False)
    pair.a.start()
    pair.b.start()
    (attack,) = pair.attack("drop-message,message=response,direction=both/1", 5.0)
    assert attack.attempts > 0
    assert all(flow.first_delivery(0.0) < 1.0 for flow in pair.stream)
