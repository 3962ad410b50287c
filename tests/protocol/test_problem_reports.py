"""Problem reports: their encoding, when they are sent, and that a receiver only keeps them."""

from __future__ import annotations

import pytest

from tests.protocol.harness import Pair, Side, datagrams, only, quiet, reasons, state_of
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.problem_reports import OwnProblems, ProblemReport, parse_problem_report

BOTH = quiet(features=c.KNOWN_FEATURES)


def report(side: Side, now: float, *codes: int) -> list[bytes]:
    """The datagrams by which a side reports these problems."""
    return datagrams(side.node.report_problems(side.peer, codes, now))


def test_encoding_is_the_documented_one() -> None:
    """A byte for each of at most eight ascending codes, also unknown ones."""
    assert ProblemReport((2, 255)).encode().hex() == "0802ff"
    for codes in (b"", b"\x00", bytes(range(248, 256))):
        assert parse_problem_report(b"\x08" + codes) == ProblemReport(tuple(codes))
    for codes in (b"\x02\x01", b"\x01\x01", bytes(range(9))):
        assert parse_problem_report(b"\x08" + codes) is None


def test_changes_and_new_keys_are_reported_twice_and_what_lasts_each_minute() -> None:
    """However often they change, a peer gets one report per interval. The smallest codes are reported."""
    own, sent = OwnProblems(), list[float]()
    for second in range(300):
        codes = (200, *range(20, 0, -1)) if 10 <= second < 200 else ()
        if (taken := own.take(codes, 1, float(second))) is not None:
            sent.append(second)
            assert taken.codes == (tuple(range(1, 9)) if codes else ())
    assert sent == [0, 2, 10, 12, 72, 132, 192, 200, 202]
    assert own.take((200, 9), 2, 300.0) == ProblemReport((9, 200))
    flapping = [now for now in range(302, 322) if own.take([now % 256], 2, float(now)) is not None]
    assert flapping == [*range(302, 322, 2)]


def test_a_peer_that_restarted_soon_gets_a_report_again() -> None:
    """Both ends have lost their sessions, so the generation of the next one is the one before."""
    pair = Pair(link_a=BOTH, link_b=BOTH).establish()
    assert report(pair.b, 1.0, 2)
    assert report(pair.b, 3.0, 2)
    pair.b.receive(only(datagrams(pair.a.node.close(4.0))), 4.0)
    pair.a.configure_path(10.0)
    pair.establish(10.0)
    assert pair.b.session.parameters.generation == 1
    assert report(pair.b, 10.0, 2)


@pytest.mark.parametrize(("ours", "theirs"), [(c.KNOWN_FEATURES, 3), (3, c.KNOWN_FEATURES)])
def test_an_old_peer_gets_no_report(ours: int, theirs: int) -> None:
    """And one that arrives without the feature is a counted drop, as any unknown record is."""
    pair = Pair(link_a=quiet(features=ours), link_b=quiet(features=theirs)).establish()
    assert report(pair.a, 1.0, 1) == report(pair.b, 1.0, 1) == []
    uninvited = pair.a.envelope(1.0, ProblemReport((1,)).encode())
    assert reasons(pair.b.receive(uninvited, 1.0)) == [DropReason.BAD_CONTROL]
    assert pair.b.peer.problem_claim.codes == ()
    assert pair.carries(1.0)


def test_a_claim_changes_nothing_else() -> None:
    """A flood of reports leaves the receiver as keepalives would: only the newest one is kept."""
    pair, twin = (Pair(link_a=BOTH, link_b=BOTH).establish() for _ in range(2))
    for number in range(250):
        assert pair.b.receive(pair.a.envelope(1.0, ProblemReport((number, 255)).encode()), 1.0) == []
        twin.b.receive(twin.a.envelope(1.0, b""), 1.0)
    assert pair.b.peer.problem_claim == ((249, 255), 1.0)
    pair.b.peer.traffic.bytes_received = twin.b.peer.traffic.bytes_received
    for name in ("timers", "traffic", "path", "is_up", "received_at", "unanswered_since", "refusal_claims"):
        ours, theirs = (state_of(getattr(side.peer, name)) for side in (pair.b, twin.b))
        assert ours == theirs, name


def test_after_a_silence_the_peer_is_asked_whether_a_report_is_new() -> None:
    """An old report does not hide a newer one."""
    pair, later = Pair(link_a=BOTH, link_b=BOTH).establish(), 3 * c.LATE_AFTER_S
    first, second = (only(report(pair.b, later + after_s, *codes)) for after_s, codes in ((0.0, (1,)), (2.0, (2,))))
    now = later + 2.0
    questions = datagrams(pair.a.receive(second, now)) + datagrams(pair.a.receive(first, now))
    assert pair.a.peer.problem_claim.codes == ()
    for question in questions:
        for answer in datagrams(pair.b.receive(question, now + 0.1)):
            pair.a.receive(answer, now + 0.2)
    assert pair.a.peer.problem_claim == ((2,), now + 0.2)


def test_a_report_on_a_superseded_session_is_ignored() -> None:
    """The peer has sent on newer keys for a while, so it is not asked either."""
    pair = Pair(link_a=BOTH, link_b=BOTH).establish()
    late = pair.a.envelope(1.0, ProblemReport((1,)).encode())
    pair.rekey(121.0)
    assert pair.carries(121.0)
    assert pair.carries(124.0)
    assert pair.b.receive(late, 125.0) == []
    assert pair.b.peer.problem_claim.codes == ()
