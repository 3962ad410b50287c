"""Refusal and problem reports: what is sent and when, what a receiver keeps, and that nothing acts on a claim."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.protocol.harness import (
    AT_A,
    ELSEWHERE,
    Pair,
    Side,
    datagrams,
    of,
    only,
    quiet,
    reasons,
    state_of,
    unsealed,
)
from tests.protocol.independent_records import refusal_report
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.outputs import Transmit
from uavlinkd.protocol.reports import Claims, OwnReports
from uavlinkd.protocol.timers import Timer
from uavlinkd.protocol.wire import ProblemReport, RefusalReport, Refused, Report, parse_control

ARM = Refused(76, 400, 4, 1)
HEARTBEAT = Refused(0, 0, 1, 7)
MOST = 2**32 - 1


def own(*refused: Refused) -> OwnReports:
    """The reports of an end that refuses these frames."""
    reports = OwnReports()
    reports.update_refusals(refused)
    return reports


def totals(report: RefusalReport | None) -> list[tuple[int, int]]:
    """Message and total of each entry."""
    return [] if report is None else [(refused.message, refused.total) for refused in report.entries]


def claims(side: Side) -> list[Refused]:
    """What a side believes that the other one refuses."""
    return [claim.refused for claim in side.peer.claims.refusals()]


def report(side: Side, now: float, *refused: Refused) -> list[bytes]:
    """The datagrams by which a side reports these totals."""
    return datagrams(side.node.report_refusals(side.peer, refused, now))


def report_problems(side: Side, now: float, *codes: int) -> list[bytes]:
    """The datagrams by which a side reports these problems."""
    return datagrams(side.node.report_problems(side.peer, codes, now))


# The records.


def parsed(payload: bytes) -> object:
    """The record in a payload; None if it is invalid."""
    try:
        return parse_control(payload)
    except Drop:
        return None


def test_encoding_is_the_documented_one() -> None:
    """Byte by byte, as the specification draws it: 1 to 16 whole entries, which fit the smallest envelope."""
    encoded = RefusalReport((ARM, Refused(0x123456, 0, 255, MOST))).encode()
    assert encoded.hex(" ") == "06 00 00 4c 01 90 04 00 00 00 01 12 34 56 00 00 ff ff ff ff ff"
    assert encoded == refusal_report(ARM, (0x123456, 0, 255, MOST))
    valid = [size for size in range(1, 182) if parsed(bytes((6,)) + bytes(size - 1)) is not None]
    assert valid == [1 + 10 * count for count in range(1, c.REFUSALS_PER_REPORT + 1)]
    assert valid[-1] <= c.MIN_ENVELOPE_LIMIT - 39


def test_encoding_of_problems_is_the_documented_one() -> None:
    """A byte for each of at most eight ascending codes, also unknown ones."""
    assert ProblemReport((2, 255)).encode().hex() == "0802ff"
    for codes in (b"", b"\x00", bytes(range(248, 256))):
        assert parsed(b"\x08" + codes) == ProblemReport(tuple(codes))
    for codes in (b"\x02\x01", b"\x01\x01", bytes(range(9))):
        assert parsed(b"\x08" + codes) is None


# The sender.


def test_changes_are_reported_twice_at_an_interval() -> None:
    """Without new totals there is no report; however fast they grow, a peer gets one per interval."""
    reports = own()
    assert reports.next_refusals(0.0) is None
    sent = []
    for second in range(0, 60, 2):
        reports.update_refusals([ARM])
        sent.append(reports.next_refusals(float(second)))
    assert len([one for one in sent if one is not None]) == c.REFUSALS_SENDS
    moments = []
    for tenth in range(1000, 1200):
        reports.update_refusals([ARM._replace(total=tenth)])
        if reports.next_refusals(tenth / 10) is not None:
            moments.append(tenth / 10)
    assert moments == [100.0 + 2.0 * number for number in range(10)]


def test_memory_of_the_sender_is_bounded() -> None:
    """The kind that changed longest ago is forgotten. The oldest are reported first. A total has 32 bits."""
    reports = own(*(Refused(number, 0, 2, 1) for number in range(c.REFUSALS_KEPT)))
    reports.update_refusals([Refused(0, 0, 2, 2), Refused(9999, 0, 2, 1)])  # 0 changed again: 1 is now the oldest
    assert len(reports.refusals) == c.REFUSALS_KEPT
    reported = [totals(reports.next_refusals(now)) for now in range(0, 20, 2)]
    kept = [*((number, 1) for number in range(2, c.REFUSALS_KEPT)), (0, 2), (9999, 1)]
    first, last = kept[:16], kept[48:]
    assert reported == [first, first, *[kept[16:32]] * 2, *[kept[32:48]] * 2, last, last, [], []]
    reports = own(ARM._replace(total=2**40))
    assert [totals(reports.next_refusals(now)) for now in (0.0, 2.0)] == [[(76, MOST)]] * 2
    reports.update_refusals([ARM._replace(total=2**41)])
    assert reports.next_refusals(4.0) is None


def test_problems_are_reported_after_changes_and_each_minute() -> None:
    """However often they change, a peer gets one report per interval. The smallest codes are reported."""
    reports, sent = OwnReports(), list[float]()
    for second in range(300):
        codes = (200, *range(20, 0, -1)) if 10 <= second < 200 else ()
        if (taken := reports.next_problems(codes, 1, float(second))) is not None:
            sent.append(second)
            assert taken.codes == (tuple(range(1, 9)) if codes else ())
    assert sent == [0, 2, 10, 12, 72, 132, 192, 200, 202]
    assert reports.next_problems((200, 9), 2, 300.0) == ProblemReport((9, 200))
    flapping = [now for now in range(302, 322) if reports.next_problems([now % 256], 2, float(now)) is not None]
    assert flapping == [*range(302, 322, 2)]


def test_report_needs_a_session_that_can_seal() -> None:
    """What is refused without one is reported when there is a session. A lost report is repeated."""
    pair = Pair()
    assert report(pair.b, 0.0, ARM) == report_problems(pair.b, 0.0, 1) == []
    pair.establish()
    assert report(pair.b, 500.0) == []
    assert report(pair.b, 1.0)  # lost
    pair.a.receive(pair.b.envelope(2.0), 2.0)
    pair.a.receive(only(report(pair.b, 3.0, ARM)), 3.0)
    assert claims(pair.a) == [ARM]
    assert report(pair.b, 5.0, ARM) == []
    pair.b.session.send_counter = c.SESSION_ENVELOPE_LIMIT
    assert report(pair.b, 9.0, HEARTBEAT) == []


def test_a_report_asks_for_nothing_and_goes_where_the_traffic_goes() -> None:
    """It starts no timer of a silence, so two ends cannot keep each other busy. Its bytes are counted."""
    pair = Pair().establish()
    peer = pair.b.peer
    pair.b.receive(pair.a.envelope(1.0), 1.0, ELSEWHERE)
    peer.unanswered_since = None
    peer.timers.stop(Timer.SILENCE)
    before = peer.paths.totals.bytes_sent
    sent = only(of(pair.b.node.report_refusals(peer, [ARM], 1.0), Transmit))
    assert sent.path == AT_A
    assert unsealed(pair.a.session, sent.datagram) == RefusalReport((ARM,)).encode()
    assert peer.paths.totals.bytes_sent == before + len(sent.datagram)
    assert peer.unanswered_since is None
    assert peer.timers.deadlines[Timer.SILENCE] == c.NEVER
    assert pair.a.receive(sent.datagram, 1.0) == []


def test_a_peer_that_restarted_soon_gets_a_report_again() -> None:
    """Both ends have lost their sessions, so the generation of the next one is the one before."""
    pair = Pair().establish()
    assert report_problems(pair.b, 1.0, 2)
    assert report_problems(pair.b, 3.0, 2)
    pair.b.receive(only(datagrams(pair.a.node.close(4.0))), 4.0)
    pair.a.configure_path(10.0)
    pair.establish(10.0)
    assert pair.b.session.parameters.generation == 1
    assert report_problems(pair.b, 10.0, 2)


# The feature bits.


@pytest.mark.parametrize(("ours", "theirs"), [(5, 0), (0, 5), (4, 1)])
def test_both_ends_must_agree(ours: int, theirs: int) -> None:
    """Without the bit of either end no report is sent, and one that arrives is invalid."""
    pair = Pair(link_a=quiet(features=ours), link_b=quiet(features=theirs)).establish()
    assert pair.a.session.parameters.features == pair.b.session.parameters.features == 0
    for side in (pair.a, pair.b):
        assert report(side, 1.0, ARM) == report_problems(side, 1.0, 1) == []
    for record in (RefusalReport((ARM,)), ProblemReport((1,))):
        assert reasons(pair.b.receive(pair.a.envelope(1.0, record.encode()), 1.0)) == [DropReason.BAD_CONTROL]
    assert claims(pair.b) == []
    assert pair.b.peer.claims.problems.codes == ()
    assert pair.carries(1.0)


# The receiver.


def test_claims_are_bounded_and_repeated_ones_keep_their_time() -> None:
    """A peer replaces its own claims. Only a change is new, such as a smaller total after a restart."""
    kept = Claims()
    for now, total in ((1.0, 5), (3.0, 5), (5.0, 2)):
        kept.note(RefusalReport((ARM._replace(total=total),)), now)
        (claim,) = kept.refusals()
        assert (claim.refused.total, claim.changed_at) == (total, 1.0 if now < 5 else 5.0)
    for number in range(1000, 2000):
        kept.note(RefusalReport((Refused(number, 0, 2, 1),)), float(number))
    assert [claim.refused.message for claim in kept.refusals()] == [*range(1999, 1999 - c.REFUSALS_KEPT, -1)]


def _refusals(number: int) -> Report:
    return RefusalReport(tuple(Refused(number * 16 + place, 400, 4, 9) for place in range(16)))


@pytest.mark.parametrize("report_of", [_refusals, lambda number: ProblemReport((number % 250, 255))])
def test_a_claim_changes_nothing_else(report_of: Callable[[int], Report]) -> None:
    """A flood of claims leaves the receiver as keepalives would: only the claims, in bounded memory, are added."""
    pair, twin = Pair().establish(), Pair().establish()
    for number in range(500):
        assert pair.b.receive(pair.a.envelope(1.0, report_of(number).encode()), 1.0) == []
        twin.b.receive(twin.a.envelope(1.0, b""), 1.0)
    if report_of is _refusals:
        assert len(claims(pair.b)) == c.REFUSALS_KEPT
    else:
        assert pair.b.peer.claims.problems == ((249, 255), 1.0)
    for name in ("timers", "traffic", "path", "is_up", "received_at", "unanswered_since"):
        ours, theirs = (state_of(getattr(side.peer, name)) for side in (pair.b, twin.b))
        assert ours == theirs, name
    for name in ("send_counter", "window", "verification", "trusted_until", "reject_at"):
        ours, theirs = (state_of(getattr(side.session, name)) for side in (pair.b, twin.b))
        assert ours == theirs, name


def test_an_old_report_changes_nothing() -> None:
    """Neither one that arrives after a silence, nor one of a session that another one replaced."""
    pair = Pair().establish()
    held_back = only(report(pair.b, 0.5, ARM))
    pair.a.receive(held_back, 0.5 + 2 * c.LATE_AFTER_S)
    assert claims(pair.a) == []
    pair = Pair().establish()
    held_back = only(report(pair.b, 0.5, ARM))
    pair.rekey(1.0)
    pair.a.receive(pair.b.envelope(1.0), 1.0)
    pair.a.receive(only(report(pair.b, 2.6, ARM._replace(total=9))), 2.6)
    pair.a.receive(held_back, 1.0 + c.LATE_AFTER_S)
    assert claims(pair.a) == [ARM._replace(total=9)]


@pytest.mark.parametrize(("arrives_after_s", "counts"), [(0.0, True), (2 * c.LATE_AFTER_S, False)])
def test_after_a_silence_the_peer_is_asked_whether_a_report_is_new(arrives_after_s: float, counts: bool) -> None:
    """On an idle link nearly every report comes so. The newest one of each kind is kept."""
    pair, later = Pair().establish(), 3 * c.LATE_AFTER_S
    newer = ARM._replace(total=ARM.total + 1)
    first, second = (only(report(pair.b, later + after_s, entry)) for after_s, entry in ((0.0, ARM), (2.0, newer)))
    problem = only(report_problems(pair.b, later + 2.0, 2))
    now = later + 2.0 + arrives_after_s
    arrived = [second, first, problem]
    if arrives_after_s:
        pair.b.timeout(now)
        arrived.insert(0, pair.b.envelope(now))  # an empty one comes before, and is asked about: all below it is old
    questions = [question for datagram in arrived for question in datagrams(pair.a.receive(datagram, now))]
    assert claims(pair.a) == []
    answers = [answer for question in questions for answer in datagrams(pair.b.receive(question, now + 0.1))]
    assert answers
    for answer in answers:
        pair.a.receive(answer, now + 0.2)
    assert claims(pair.a) == ([newer] if counts else [])
    assert pair.a.peer.claims.problems.codes == ((2,) if counts else ())
