"""Which gaps in the counters of a peer count as lost envelopes."""

from __future__ import annotations

from collections.abc import Callable

from tests.core.harness import AT_B, ELSEWHERE, PLAIN, Pair, Side, datagrams, of, quiet
from uavlinkd.core import wire
from uavlinkd.core.missing import FIRST_WAITS_S, REGULAR_AFTER_S, WAITS_S, MissingEnvelopes
from uavlinkd.core.outputs import Output, Transmit

OLD_S = REGULAR_AFTER_S


def test_gaps_of_a_peer_without_reports_count_at_once() -> None:
    """It has one path."""
    losses = MissingEnvelopes()
    assert [losses.count(gaps, now) for gaps, now in [(0, 0.0), (3, 1.0), (3, 2.0), (7, 3.0)]] == [0, 3, 3, 7]


def test_gaps_count_as_far_as_paths_that_work_lost_datagrams() -> None:
    """The others are probes along a path that is down. A later report explains an earlier gap."""
    losses = MissingEnvelopes()
    losses.note_report(0, 0.0, OLD_S, asks=True)
    assert losses.count(5, 1.0) == 0
    losses.note_report(2, 2.0, OLD_S, asks=True)
    assert losses.count(5, 3.0) == 2
    assert losses.count(6, 4.0) == 2


def test_losses_along_one_path_without_a_gap_do_not_count() -> None:
    """A copy arrived along another path. A gap of much later is another matter."""
    losses = MissingEnvelopes()
    losses.note_report(9, 0.0, OLD_S, asks=True)
    assert losses.count(0, 1.0) == 0
    assert losses.count(4, 2.0) == 4
    losses.note_report(0, 2.0 + WAITS_S, OLD_S, asks=True)
    assert losses.count(5, 2.0 + WAITS_S) == 4


def test_answers_alone_delay_nothing() -> None:
    """A peer with one path answers the questions of this end."""
    losses = MissingEnvelopes()
    losses.note_report(0, 0.0, OLD_S, asks=False)
    assert losses.count(3, 1.0) == 3


def test_gaps_count_again_when_the_peer_no_longer_reports() -> None:
    """Those that waited for a report too."""
    losses = MissingEnvelopes()
    losses.note_report(0, 0.0, OLD_S, asks=True)
    assert losses.count(3, WAITS_S) == 0
    assert losses.count(4, WAITS_S + 0.1) == 4
    assert losses.count(5, WAITS_S + 0.2) == 5


def test_a_question_when_a_session_begins_delays_the_first_count_only() -> None:
    """A peer with one path asks along it once for each session."""
    losses = MissingEnvelopes()
    losses.note_report(0, 0.0, 0.1, asks=True)
    losses.note_report(0, FIRST_WAITS_S - 1.0, 0.1, asks=True)
    assert losses.count(3, FIRST_WAITS_S) == 0
    assert losses.count(3, FIRST_WAITS_S + 0.1) == 3


def test_a_question_delays_the_count_again_once_none_waits() -> None:
    """A peer that restarted searches for a direct path from the first moment of its session."""
    losses = MissingEnvelopes()
    losses.note_report(0, 0.0, OLD_S, asks=True)
    assert losses.count(3, WAITS_S + 0.1) == 3
    losses.note_report(0, WAITS_S + 1.0, 0.0, asks=True)
    assert losses.count(8, WAITS_S + 3.0) == 3
    losses.note_report(2, WAITS_S + 6.0, OLD_S, asks=True)
    assert losses.count(8, WAITS_S + 7.0) == 5


Passes = Callable[[Side, Transmit, float], bool]


def fly(pair: Pair, begin: float, end: float, passes: Passes) -> None:
    """Ten frames a second in both directions; what ``passes`` arrives, along the only path that works."""
    queue: list[tuple[Side, list[Output]]] = []
    for step in range(round(20 * begin), round(20 * end)):
        now = step / 20
        for side in (pair.a, pair.b):
            queue.append((side, side.timeout(now)))
            if step % 2:
                queue.append((side, side.send(now)))
        while queue:
            side, outputs = queue.pop(0)
            other = pair.b if side is pair.a else pair.a
            for out in of(outputs, Transmit):
                if out.path == other.at and passes(side, out, now):
                    queue.append((other, other.receive(out.datagram, now)))
        pair.b.peer.missing(now)


def is_frame(out: Transmit) -> bool:
    """Whether it is the envelope of a frame alone."""
    return out.datagram[0] in (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE) and len(out.datagram) == 5 + 21 + 16


def test_probes_along_a_dead_path_are_not_missing() -> None:
    """Every frame arrives, and the gaps are many. Then frames are lost along the path that works: those count."""
    pair = Pair(quiet(), quiet())
    pair.a.node.set_paths(pair.a.peer, [AT_B, ELSEWHERE], 0.0)
    initiation = next(out for out in of(pair.a.timeout(0.0), Transmit) if out.path == AT_B)
    for response in datagrams(pair.b.receive(initiation.datagram, 0.0)):
        for out in of(pair.a.receive(response, 0.0), Transmit):
            if out.path == AT_B:
                pair.b.receive(out.datagram, 0.0)
    fly(pair, 0.0, 40.0, lambda *_: True)
    assert pair.b.session.missing(40.0) > 20
    assert pair.b.peer.missing(40.0) == 0

    dropped = 0

    def drops(side: Side, out: Transmit, now: float) -> bool:
        nonlocal dropped
        is_lost = side is pair.a and is_frame(out) and now < 43.0
        dropped += is_lost
        return not is_lost

    fly(pair, 40.0, 55.0, drops)
    assert dropped >= 25
    assert pair.b.peer.missing(55.0) == dropped


def test_all_gaps_of_a_peer_with_one_path_are_missing() -> None:
    """Although this end asked along the path when the session began, and the answer was a report."""
    pair = Pair(PLAIN, PLAIN).establish()
    lost: list[float] = []

    def drops(side: Side, out: Transmit, now: float) -> bool:
        is_lost = side is pair.a and is_frame(out) and now < 5.0
        lost.extend([now] * is_lost)
        return not is_lost

    fly(pair, 1.0, 12.0, drops)
    assert len(lost) >= 30
    assert pair.b.peer.missing(12.0) == len(lost)
