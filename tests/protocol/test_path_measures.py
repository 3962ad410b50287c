"""What is measured of paths: loss although envelopes are repeated, the longest envelope, and missing envelopes."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field

import pytest

from tests.protocol.harness import AT_B, Named, of
from tests.protocol.radios import Radios
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.outputs import PathChanged, Transmit
from uavlinkd.protocol.path import Path, SocketFacts
from uavlinkd.protocol.path_measures import (
    FIRST_WAITS_S,
    NO_REPEATS,
    REGULAR_AFTER_S,
    WAITS_S,
    EnvelopeLimit,
    MissingEnvelopes,
    PathLoss,
    Repeats,
    datagram_loss,
)
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.send import send_again
from uavlinkd.protocol.settings import Redundancy

# Loss.


def counts(*repeats: int) -> Repeats:
    """So many second transmissions, third ones and so on; further ones were not needed."""
    return (*repeats, *NO_REPEATS[len(repeats) :])


@pytest.mark.parametrize("loss", [0.0, 0.02, 0.05, 0.1, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("repeated", [0.0, 0.5, 0.9])
def test_loss_of_datagrams_is_found_although_repeats_hide_it(loss: float, repeated: float) -> None:
    """Whatever share of the envelopes is repeated, as long as some are not. Without any loss it is exactly 0."""
    rng = random.Random(1)
    lost, sent, repeats = 0, 20_000, [0] * (c.TRANSMISSIONS - 1)
    for _ in range(sent):
        times = c.TRANSMISSIONS if rng.random() < repeated else 1
        for number in range(times - 1):
            repeats[number] += 1
        lost += all(rng.random() < loss for _ in range(times))
    assert datagram_loss(lost, sent, repeats) == pytest.approx(loss, abs=0.02 if loss else 0.0)


def test_share_needs_two_reports_and_envelopes_between_them() -> None:
    """Half of the datagrams are lost, so a quarter of the envelopes that were sent twice."""
    loss = PathLoss()
    assert (loss.share(), loss.reported_at) == (0.0, -NEVER)
    for at, sent, received in ((1.0, 10, 5), (2.0, 10, 5)):
        loss.add(at, sent, received)
        assert (loss.share(), loss.reported_at) == (0.0, at)
    loss.add(3.0, 110, 80, counts(100))
    assert loss.share() == pytest.approx(0.5, abs=1e-3)
    assert loss.recent(c.LOSS_WINDOW_S) == (100, 25)


def test_repeats_that_were_counted_along_another_path_are_not_compared() -> None:
    """Fewer repeats than before: the estimate begins with that report."""
    loss = PathLoss()
    loss.add(1.0, 10, 10, counts(90))
    loss.add(2.0, 100, 80, counts(50))
    assert loss.recent(c.LOSS_WINDOW_S) == (0, 0)
    loss.add(3.0, 200, 155, counts(150))
    assert loss.recent(c.LOSS_WINDOW_S) == (100, 25)
    assert loss.share() == pytest.approx(0.5, abs=1e-3)


def test_reports_are_limited_in_age_and_number() -> None:
    """The window of repair is the longest one. An older report, or one of fewer envelopes, does not count."""
    loss = PathLoss()
    for number in range(1000):
        loss.add(number / 100, 2 * number, number)
        assert loss.share() == pytest.approx(0.5 if number else 0.0)
    assert len(loss._points) == c.LOSS_POINTS
    loss.add(10.0, 1998, 998)
    loss.add(10.0, 1997, 999)
    assert loss.recent(NEVER)[1] == loss.recent(NEVER)[0] // 2
    for number in range(1000, 1100):
        loss.add(float(number), 2 * number, number)
    assert len(loss._points) <= c.REPAIR_WINDOW_S + 2


def test_repeat_is_counted_in_bytes_but_not_as_another_envelope() -> None:
    """The receiver counts an envelope once too. Repeats of an envelope of an older session do not count."""
    radios = Radios().run(1.0)
    node, peer, state = radios.a.node, radios.a.peer, radios.state(radios.a, 0)
    old = radios.pair.a.envelope(radios.now)
    radios.act(radios.a, establish.initiate(peer, radios.now))
    radios.run(0.5)
    envelope = radios.pair.a.envelope(radios.now)
    sent, datagrams_sent, size = state.sent, state.datagrams_sent, state.bytes_sent
    for number, datagram in ((2, envelope), (3, envelope), (2, old)):
        assert send_again(peer, state, datagram, number) == Transmit(datagram, state.path)
    assert state.repeats == counts(1, 1)
    assert (state.sent, state.datagrams_sent) == (sent, datagrams_sent + 3)
    assert state.bytes_sent == size + 2 * len(envelope) + len(old)
    node.close(radios.now)
    send_again(peer, state, old, 2)
    assert state.repeats == counts(1, 1)
    state.note_session()
    assert sum(state.repeats) == 0


def test_echoes_show_the_loss_of_the_only_path() -> None:
    """The newest report counts, of a probe or of an echo reply."""
    state = PathState(AT_B, 1, 0.0, is_configured=True, is_metered=False)
    assert state.loss_to_repair() == (0.0, 0)
    state.loss_by_echo.add(1.0, 10, 10)
    state.loss_by_echo.add(2.0, 20, 17)
    assert state.loss_to_repair() == (0.3, 3)
    assert state.loss_out == 0.3


FAST, SLOW = Path(0, ("192.0.2.1", 5790)), Path(1, ("192.0.2.2", 5790))


class Course:
    """Two usable paths whose questions are answered. The fast one loses half of the stream while it is the best."""

    def __init__(self) -> None:
        self.paths = PathSet(Redundancy.CRITICAL, c.PROBE_IDLE_S, Counter(), SocketFacts())
        self.paths.configure((FAST, SLOW), 0.0)
        self.now = 0.0
        self.loses = True
        self.changes: list[tuple[float, Path, str]] = []
        self._received = {FAST: 0, SLOW: 0}
        self.fast = self.paths.prefer(FAST, 0.0)

    def run(self, until: float) -> None:
        """Each path carries forty datagrams a second, and a question."""
        while self.now < until:
            self.now += 0.25
            for path, round_trip_s in ((FAST, 0.05), (SLOW, 0.1)):
                state = self.paths.by_path[path]
                state.sent += 10
                self._received[path] += 5 if self.loses and self.fast is state is self.paths.best else 10
                state.make_probe(round(self.now * 100), 0, self.now - round_trip_s)
                assert state.receive_answer(round(self.now * 100), self._received[path] + 1, self.now) is not None
                self.paths.note_answer(state, self.now)
            for change in of(self.paths.update(Named("bravo"), self.now), PathChanged):
                self.changes.append((self.now, change.path, change.reason))


def test_a_path_that_loses_only_the_stream_comes_back_ever_later() -> None:
    """Its loss is forgotten within seconds; then it waits for 4 s, 8 s and so on, at most for 64 s."""
    course = Course()
    course.run(400.0)
    assert {reason for _, path, reason in course.changes if path == SLOW} == {"loss"}
    left, back = ([at for at, path, _ in course.changes if path == one] for one in (SLOW, FAST))
    waits = [later - earlier for earlier, later in zip(left, back, strict=False)]
    assert waits == sorted(waits)
    assert waits[1:5] == pytest.approx([10.0, 18.0, 34.0, 66.0], abs=0.5)
    assert len(course.changes) < 18  # every nine seconds without it


def test_a_path_that_was_the_best_for_long_does_not_wait() -> None:
    """One bad time of a radio does not count indefinitely."""
    course = Course()
    course.run(60.0)
    course.loses = False
    course.run(60.0 + 4 * c.HELD_BACK_MOST_S)
    assert course.paths.best is course.fast
    assert course.fast.held_back_s > 0.0
    course.loses = True
    course.run(course.now + 10.0)
    assert course.fast.held_back_s == 0.0


# The longest envelope.

LONGEST = 1232
NONE = c.MIN_ENVELOPE_LIMIT


@dataclass
class Narrow:
    """A limit, and a path that carries envelopes up to a length."""

    carries: int
    answers: bool = True
    """Whether short questions are answered."""
    limit: EnvelopeLimit = field(default_factory=EnvelopeLimit)
    sizes: list[int] = field(default_factory=list)

    def run(self, until: float) -> tuple[int, int]:
        """Send what is due. Returns the limit and the length that the path drops."""
        limit = self.limit
        while (now := limit.due_at) <= until:
            if size := limit.next_size(LONGEST, now - 0.01 if self.answers else -1.0, 0.02, now):
                self.sizes.append(size)
                if size <= self.carries:
                    limit.acknowledge(size, now)
        return limit.limit, limit.dropped


@pytest.mark.parametrize(
    ("carries", "result", "sizes"),
    [
        (LONGEST, (LONGEST, 0), [LONGEST]),
        (1096, (1024, LONGEST), [LONGEST] * c.LIMIT_TESTS + [1024]),
        (400, (NONE, 548), [size for size in (LONGEST, 1024, 768, 548) for _ in range(c.LIMIT_TESTS)]),
    ],
)
def test_the_limit_is_the_longest_envelope_that_was_acknowledged(
    carries: int, result: tuple[int, int], sizes: list[int]
) -> None:
    """The path is tested from the session's length on; a path whose network changed is tested again."""
    path = Narrow(carries)
    assert path.run(1e9) == (NONE, 0), "not before the path is proved"
    path.limit.begin(100.0)
    assert path.run(110.0) == result
    assert path.sizes == sizes
    path.limit.begin(120.0)
    assert path.limit.limit == NONE
    assert path.run(130.0) == result
    assert path.sizes == sizes * 2


def test_limit_is_not_lowered_without_other_answers() -> None:
    """The silence says nothing about length then."""
    path = Narrow(0, answers=False)
    path.limit.begin(0.0)
    assert path.run(60.0) == (NONE, 0)
    assert {*path.sizes} == {LONGEST}


def test_path_that_carries_more_again_is_noticed_by_one_test_a_minute() -> None:
    """Meanwhile the limit stays."""
    path = Narrow(1096)
    path.limit.begin(0.0)
    path.run(10.0)
    path.sizes.clear()
    assert path.run(10.0 + 2 * c.LIMIT_RAISE_S) == (1024, LONGEST)
    assert path.sizes == [LONGEST] * 2
    path.carries = LONGEST
    assert path.run(10.0 + 4 * c.LIMIT_RAISE_S) == (LONGEST, 0)
    assert path.sizes == [LONGEST] * 3


def test_losses_make_a_path_acknowledge_its_limit_again() -> None:
    """Frames share short envelopes until then. It happens at most every ten seconds."""
    path = Narrow(1096)
    path.limit.begin(0.0)
    path.run(10.0)
    path.sizes.clear()
    path.limit.note_lost(c.LIMIT_LOSSES - 1, 20.0)
    assert path.limit.limit == 1024
    path.limit.note_lost(c.LIMIT_LOSSES, 20.0)
    assert path.limit.limit == NONE
    path.limit.note_lost(c.LIMIT_LOSSES, 20.0)
    assert path.run(20.0) == (1024, LONGEST)
    path.limit.note_lost(c.LIMIT_LOSSES, 20.0 + c.LIMIT_DOUBT_S - 0.01)
    assert path.limit.limit == 1024
    path.carries = 800
    path.limit.note_lost(c.LIMIT_LOSSES, 20.0 + c.LIMIT_DOUBT_S)
    assert path.run(40.0) == (768, 1024)
    assert path.sizes == [1024] + [1024] * c.LIMIT_TESTS + [768]


# Missing envelopes.

OLD_S = REGULAR_AFTER_S


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param(["count 0 0 0", "count 1 3 3", "count 2 3 3", "count 3 7 7"], id="one path, no reports"),
        pytest.param(
            ["ask 0 0 old", "count 1 5 0", "ask 2 2 old", "count 3 5 2", "count 4 6 2"], id="a later report explains"
        ),
        pytest.param(
            ["ask 0 9 old", "count 1 0 0", "count 2 4 4", "ask 22 0 old", "count 22 5 4"], id="lost along one path"
        ),
        pytest.param(["ask 0 5 old", "count 1 2 2", "count 2 5 5", "count 3 6 5"], id="several gaps"),
        pytest.param(["answer 0 0 old", "count 1 3 3"], id="answers alone"),
        pytest.param(["ask 0 0 old", "count 20 3 0", "count 20.1 4 4", "count 20.2 5 5"], id="reports end"),
        pytest.param(
            ["ask 0 0 0.1", "count 2 1 0", "ask 4 0 0.1", "count 8 4 0", "count 8.1 5 4"], id="first question"
        ),
        pytest.param(
            ["ask 0 0 old", "count 20.1 3 3", "ask 21 0 0", "count 23 8 3", "ask 26 2 old", "count 27 8 5"],
            id="a question once none waits",
        ),
    ],
)
def test_gaps_that_are_losses(steps: list[str]) -> None:
    """``ask`` or ``answer``: a report, when, its losses, the session's age. ``count``: when, all gaps, losses."""
    assert (WAITS_S, FIRST_WAITS_S) == (20.0, 8.0)
    losses = MissingEnvelopes()
    for step in steps:
        kind, now, number, last = step.split()
        if kind == "count":
            assert losses.count(int(number), float(now)) == int(last), step
        else:
            age_s = OLD_S if last == "old" else float(last)
            losses.note_report(int(number), float(now), age_s, asks=kind == "ask")
