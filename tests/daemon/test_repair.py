"""When critical envelopes are repeated, how often, within what, and what arrives then."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import pytest

from tests.samples import command
from uavlinkd.daemon.copies import AVERAGE_S, HOLD_S, KNOWN_S, LEAST_BITS_S, MAX_ENVELOPES, SPACING_S, Copies, Repair
from uavlinkd.daemon.journal import ShellReason
from uavlinkd.daemon.networks import NetworkBudget
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition, PathState

HERE, THERE = BOTH = tuple(
    PathState(Path(number, (f"192.0.{number}.2", 14600)), number, 0.0, is_configured=True, is_metered=False)
    for number in range(2)
)


class _Lossy:
    """A path of which only the loss, the round trip, and its last answer are known."""

    def __init__(
        self, loss: float, lost: int = 100, *, round_trip_s: float = 0.02, reason: str = "answered", at: float = 0.0
    ) -> None:
        self.facts = loss, lost
        self.loss_out = 0.0
        self.srtt_s = round_trip_s
        self.reason = reason
        self.condition = PathCondition.USABLE if reason == "answered" else PathCondition.SUSPECT
        self.answered_at = at

    def loss_to_repair(self) -> tuple[float, int]:
        """As of a path."""
        return self.facts


def paths(*lossy: _Lossy) -> Sequence[PathState]:
    """As the state of repair wants them."""
    return cast(Sequence[PathState], lossy)


def test_repair_begins_above_two_percent_and_ends_below_one_for_a_while() -> None:
    """Between them it stays as it is; the highest loss of the last 10 s decides."""
    repair, now = Repair(), 0.0
    for loss, is_on in ((0.02, False), (0.025, True), (0.015, True), (0.3, True), (0.015, True)):
        repair.update(paths(_Lossy(loss)), now, is_allowed=True)
        assert repair.is_on is is_on
        now += 1.0
    assert repair.transmissions == 5
    for _ in range(int(HOLD_S)):
        repair.update(paths(_Lossy(0.015)), now, is_allowed=True)
        now += 1.0
    assert (repair.is_on, repair.transmissions) == (True, 2)
    for _ in range(int(HOLD_S)):
        assert repair.is_on
        repair.update(paths(_Lossy(0.0)), now, is_allowed=True)
        now += 1.0
    assert (repair.is_on, repair.transmissions) == (False, 1)


def test_paths_together_decide() -> None:
    """Two paths that lose a tenth each lose a hundredth together; without a path there is no estimate."""
    repair = Repair()
    repair.update(paths(_Lossy(0.1), _Lossy(0.1)), 0.0, is_allowed=True)
    repair.update((), 1.0, is_allowed=True)
    assert repair.transmissions == 1
    repair.update(paths(_Lossy(0.2), _Lossy(0.2)), 2.0, is_allowed=True)
    assert repair.transmissions == 2


def transmissions(*lossy: _Lossy, now: float = 1.0) -> tuple[int, list[int]]:
    """How often envelopes are sent along these paths, and the numbers of those without repeats."""
    repair = Repair()
    repair.update(paths(*lossy), now, is_allowed=True)
    return repair.transmissions, [number for number, path in enumerate(paths(*lossy)) if path in repair.left_out]


def test_path_that_is_too_late_hides_no_loss() -> None:
    """Its copies arrive after the repeats along the fast one. If the fast one is dead, the late one counts."""
    half, late = _Lossy(0.5, reason="unanswered"), _Lossy(0.0, round_trip_s=3.8)
    assert transmissions(half, late) == (7, [1])
    assert transmissions(half, _Lossy(0.0, round_trip_s=0.9)) == (1, [])
    assert transmissions(half, late, now=KNOWN_S) == (1, [0])


def test_slow_path_that_loses_is_repaired_beside_a_fast_one_that_is_silent() -> None:
    """The fast one may be dead, and then nothing but the slow one delivers."""
    silent, slow = _Lossy(0.0, reason="unanswered"), _Lossy(0.3, round_trip_s=1.1 + 0.01)
    assert transmissions(silent, slow) == (5, [])
    assert transmissions(_Lossy(0.0), slow) == (1, [1])


def test_path_that_does_not_answer_hides_no_loss() -> None:
    """While no path answers, any of them may be dead."""
    assert transmissions(_Lossy(0.5, reason="loss"), _Lossy(0.0, reason="unanswered")) == (7, [])
    assert transmissions(_Lossy(0.5, reason="unanswered"), _Lossy(0.0, reason="unanswered")) == (7, [])
    assert transmissions(_Lossy(0.5), _Lossy(0.0, reason="unanswered"), now=KNOWN_S) == (7, [1])
    assert transmissions(_Lossy(0.5, reason="loss"), _Lossy(0.0)) == (1, [])


def test_loss_of_the_last_seconds_begins_repair() -> None:
    """The share of ten seconds is low at first."""
    sudden = _Lossy(0.03)
    sudden.loss_out = 0.3
    assert transmissions(sudden) == (5, [])


def test_two_lost_envelopes_say_nothing() -> None:
    """Repair begins with three."""
    repair = Repair()
    states: list[bool] = []
    for lost, is_allowed in ((2, True), (3, True), (3, False)):
        repair.update(paths(_Lossy(0.5, lost)), float(len(states)), is_allowed=is_allowed)
        states.append(repair.is_on)
    assert states == [False, True, False]


class Scene:
    """Repeats of one peer, sent at their deadlines."""

    def __init__(self, budgets: dict[int, NetworkBudget] | None = None) -> None:
        self.copies = Copies(budgets or {}, 0.0)
        self.sent: list[tuple[float, bytes, int]] = []

    def put(
        self, name: bytes, frames: Sequence[Frame], now: float, times: int = 5, along: Sequence[PathState] = (HERE,)
    ) -> None:
        """An envelope is sent."""
        self.copies.add(name.ljust(100, b"."), tuple(along), (), frames, times, now)

    def leaves_along(self, size: int, now: float) -> Sequence[PathState]:
        """An envelope with a command is to be sent along both paths. Where it leaves at once; nothing is repeated."""
        along, later = self.copies.divide(BOTH, now)
        self.copies.add(bytes(size), along, later, [command(1)], 1, now)
        return along

    def run(self, now: float, until: float) -> None:
        """Let time pass."""
        for _ in range(100_000):
            now = max(now, self.copies.next_deadline(now))
            if now > until:
                return
            for _, datagram, number in self.copies.release(BOTH, (), now):
                self.sent.append((round(now, 4), datagram.rstrip(b"."), number))
        raise AssertionError("deadlines without end")


def test_repeats_are_spaced_and_numbered() -> None:
    """After 5 ms, then each time twice as long, five transmissions in all; then nothing waits."""
    scene = Scene()
    scene.put(b"a", [command(1)], 1.0)
    scene.run(1.0, 5.0)
    assert scene.sent == [(1.005, b"a", 2), (1.015, b"a", 3), (1.035, b"a", 4), (1.075, b"a", 5)]
    assert not scene.copies.waiting
    assert (scene.copies.repeats_sent, scene.copies.repeat_bytes) == (4, 4 * 128)


def test_copies_that_wait_for_a_path_go_before_its_repeats() -> None:
    """They carry what has not gone there yet."""
    scene = Scene({1: (budget := NetworkBudget(8000, 0.0))})
    budget.all.spend(1000, 0.0)
    assert scene.leaves_along(100, 0.0) == (HERE,)
    scene.put(b"a", [command(1)], 0.0, along=[THERE])
    assert scene.copies.release(BOTH, (), 0.1) == []


def test_repeats_behind_copies_that_wait_need_no_polling() -> None:
    """The rate of copies is used up, the network's budget is not: the next deadline is that of the copies."""
    scene = Scene()
    scene.copies.add(bytes(3000), BOTH, (), None, 1, 0.0)
    assert scene.leaves_along(1000, 0.0) == (HERE,)
    scene.put(b"a", [command(1)], 0.0, along=[THERE])
    now, wakeups = 0.0, 0
    while scene.copies.waiting:
        now = scene.copies.next_deadline(now)
        released = scene.copies.release((THERE,), (), now)
        scene.sent += [(now, b"a", number) for _, _, number in released if number > 1]
        wakeups += 1
    assert [number for _, _, number in scene.sent] == [2, 3, 4, 5]
    assert scene.sent[0][0] > 2 * SPACING_S
    assert wakeups <= 7


@pytest.mark.parametrize(("usable", "unrepeated"), [((HERE,), ()), (BOTH, (THERE,))], ids=["gone", "left out"])
def test_nothing_is_repeated_along_a_path_that_is_gone_or_left_out(
    usable: Sequence[PathState], unrepeated: Sequence[PathState]
) -> None:
    """It is not counted either. An envelope without a path ends."""
    scene = Scene()
    scene.put(b"both", [command(1)], 0.0, along=BOTH)
    scene.put(b"there", [command(1)], 0.0, along=[THERE])
    ((path, datagram, _),) = scene.copies.release(usable, unrepeated, SPACING_S)
    assert (datagram.rstrip(b"."), path) == (b"both", HERE)
    assert (scene.copies.repeats_sent, len(scene.copies.waiting)) == (1, 1)
    assert scene.copies.release((), (), 1.0) == []
    assert not scene.copies.waiting


@pytest.mark.long
def test_rate_of_repeats_is_limited_on_average() -> None:
    """And at most so many envelopes wait: the least important one is dropped."""
    scene = Scene()
    for tick in range(3000):
        scene.put(b"%d" % tick, [command(tick)], tick / 100)
        scene.run(tick / 100, (tick + 1) / 100)
    assert len(scene.copies.waiting) <= MAX_ENVELOPES
    assert 0.95 * 30 <= scene.copies.repeat_bytes / (LEAST_BITS_S / 8) <= 30.5 + AVERAGE_S
    many = Scene()
    for tick in range(MAX_ENVELOPES + 10):
        many.put(b"%d" % tick, [command(tick)], 0.0)
    assert len(many.copies.waiting) == MAX_ENVELOPES
    assert many.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 10}
    many.copies.clear()
    assert not many.copies.waiting
