"""The attacks on two paths are effective: each succeeds against a receiver without the check that prevents it.

With all checks, they fail: see ``test_two_paths.py``.
"""

from __future__ import annotations

from math import inf
from typing import Any

import pytest

from tests.lab.mitm.test_two_paths import ATTACKS, LASTING_S
from tests.lab.mitm.two_paths import TwoPaths
from uavlinkd.core import constants as c
from uavlinkd.core import establish, probing
from uavlinkd.core.path import Path
from uavlinkd.core.path_measures import PathLoss
from uavlinkd.core.path_state import PathCondition, PathState

pytestmark = pytest.mark.long


def attacked(name: str, seconds: float = LASTING_S) -> TwoPaths:
    pair = TwoPaths(name)
    pair.attack(ATTACKS[name][0], seconds)
    return pair


def test_sender_that_does_not_compare_delays_stays_on_the_slow_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its stream is late as long as the attack lasts."""
    monkeypatch.setattr(c, "BETTER_BY_S", inf)
    pair = attacked("slowed")
    assert pair.numbers_of_best() == {1}
    assert all(flow.delivered[max(flow.delivered)] - flow.sent_at[max(flow.delivered)] > 0.2 for flow in pair.stream)


def test_sender_that_trusts_probes_loses_its_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the counts of the peer show the loss."""
    monkeypatch.setattr(PathLoss, "recent", lambda _self, _window_s: (0, 0))
    pair = attacked("frames dropped")
    assert pair.numbers_of_best() == {1}
    assert pair.lost(pair.stream) > 0.8 * 2 * LASTING_S / 0.02


def test_responder_that_answers_one_copy_never_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fastest path carries every first copy, and loses every response."""
    monkeypatch.setattr(establish, "answer_copy", lambda *_: [])
    pair = TwoPaths("responses", learns=True, starts=False)
    pair.a.start()
    pair.b.start()
    pair.attack("drop-message,message=response,direction=both/1", 10.0)
    assert not any(flow.delivered for flow in pair.stream)


@pytest.mark.parametrize("is_weak", [False, True])
def test_spoofed_source_gets_no_more_than_it_sent(is_weak: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One captured envelope: without a count of bytes, questions would go there for seconds."""
    if is_weak:
        monkeypatch.setattr(PathState, "allows", lambda _self, _size: True)
    pair = TwoPaths("one source")
    pair.attack("roam,direction=both/1,limit=2", LASTING_S)
    assert bool(pair.amplified()) is is_weak


def test_receiver_that_ignores_repeated_probes_loses_its_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """The untouched path looks dead, because the attacker is faster with its probes."""
    before, genuine = attacked("frames replaced"), probing.receive_probe
    monkeypatch.setattr(probing, "receive_probe", lambda *of, is_copy=False: [] if is_copy else genuine(*of))
    after = attacked("frames replaced")
    assert after.lost(after.stream) > 2 * before.lost(before.stream)


@pytest.mark.parametrize("is_weak", [False, True])
def test_answers_along_another_path_prove_nothing(is_weak: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second path drops everything, and carries the probes of the first one instead."""

    def take_any(self: PathState, answer: int, *rest: Any) -> float | None:
        round_trip_s = genuine(self, answer, *rest)
        if round_trip_s is None:
            self.answered_at, self._unanswered, self._unanswered_since = rest[-1], 0, inf
            return 0.02
        return round_trip_s

    genuine = PathState.receive_answer
    if is_weak:
        monkeypatch.setattr(PathState, "receive_answer", take_any)
    pair = TwoPaths("answers")
    pair.attack("drop,direction=both/2 move,kinds=probe,direction=both/1,onto=2,beside=true", LASTING_S)
    state = pair.a.peer(pair.b).paths.find(Path(0, pair.middle.listener("a", "b", 2)))
    assert state is not None
    assert (state.answered_at > pair.begun_at + 5.0) is is_weak
    assert state.condition is PathCondition.DOWN or is_weak
    assert pair.lost(pair.critical) == 0
