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
from uavlinkd.core import establish, probing, session
from uavlinkd.core.path import Path
from uavlinkd.core.path_loss import PathLoss
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.peer import Peer
from uavlinkd.core.replay import ReplayWindow


def attacked(name: str, seconds: float = LASTING_S) -> TwoPaths:
    """A pair after an attack."""
    pair = TwoPaths(name)
    pair.attack(ATTACKS[name][0], seconds)
    return pair


@pytest.mark.parametrize("name", ["copies at once", "copies after 3 s", "copies after 10 s"])
def test_receiver_without_replay_check_delivers_copies_of_another_path(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One window for all paths prevents it."""
    pair = TwoPaths(name)
    monkeypatch.setattr(ReplayWindow, "is_used", lambda _self, _counter: False)
    with pytest.raises(AssertionError, match="delivered twice"):
        pair.attack(ATTACKS[name][0], LASTING_S)


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


def test_receiver_without_a_sense_of_time_delivers_what_a_path_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames are authentic, new and 10 s old."""
    monkeypatch.setattr(c, "LATE_AFTER_S", inf)
    pair = attacked("held")
    assert max(flow.oldest_s for flow in pair.stream) > 9.0


def test_responder_that_answers_one_copy_never_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fastest path carries every first copy, and loses every response."""
    monkeypatch.setattr(establish, "answer_copy", lambda *_: [])
    pair = TwoPaths("responses", learns=True, starts=False)
    pair.a.start()
    pair.b.start()
    pair.attack("drop-message,message=response,direction=both/1", 10.0)
    assert not any(flow.delivered for flow in pair.stream)


@pytest.mark.parametrize("name", ["racing", "spoofed sources"])
def test_receiver_that_follows_every_address_loses_its_traffic(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An answered question prevents it."""
    genuine = probing.learn

    def follow(peer: Peer, path: Path, now: float) -> PathState:
        state = peer.paths.best = genuine(peer, path, now)
        state.is_proven = True
        state.set_usable(now)
        return state

    monkeypatch.setattr(probing, "learn", follow)
    pair = attacked(name, 3.0)
    assert sum(len(datagram) == 5 + 24 + 16 for _, _, datagram in pair.middle.to_strangers) > 10


@pytest.mark.parametrize("is_weak", [False, True])
def test_spoofed_source_gets_no_more_than_it_sent(is_weak: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One captured envelope: without a count of bytes, questions would go there for seconds."""
    if is_weak:
        monkeypatch.setattr(PathState, "allows", lambda _self, _size: True)
    pair = TwoPaths("one source")
    pair.attack("roam,direction=both/1,limit=2", LASTING_S)
    assert bool(pair.amplified()) is is_weak


def test_receiver_that_ignores_repeated_probes_loses_critical_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The untouched path looks dead, because the attacker is faster with its probes."""
    monkeypatch.setattr(probing, "receive_copy", lambda *_: [])
    pair = attacked("frames replaced")
    assert pair.lost(pair.critical) > 10


def test_receiver_without_tag_check_takes_altered_probes(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the frames behind them."""
    monkeypatch.setattr(session, "equal", lambda _one, _other: True)
    pair = TwoPaths("altered")
    with pytest.raises(AssertionError, match=r"altered|never sent"):
        pair.attack("bit-flip,kinds=probe", LASTING_S)


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
