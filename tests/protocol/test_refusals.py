"""Refusal reports: what is sent and when, what a receiver keeps, and that nothing acts on a claim."""

from __future__ import annotations

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
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Transmit
from uavlinkd.protocol.refusals import MAX_TOTAL, OwnRefusals, RefusalClaims, RefusalReport, Refused, parse_report
from uavlinkd.protocol.timers import Timer

ARM = Refused(76, 400, 4, 1)
HEARTBEAT = Refused(0, 0, 1, 7)


def kinds(count: int, total: int = 1) -> list[Refused]:
    """So many kinds of refused frames."""
    return [Refused(number, 0, 2, total) for number in range(count)]


def totals(report: RefusalReport | None) -> list[tuple[int, int]]:
    """Message and total of each entry."""
    assert report is not None
    return [(refused.message, refused.total) for refused in report.entries]


def claims(side: Side) -> list[Refused]:
    """What a side believes that the other one refuses."""
    return [claim.refused for claim in side.peer.refusal_claims.recent()]


def report(side: Side, now: float, *refused: Refused) -> list[bytes]:
    """The datagrams by which a side reports these totals."""
    return datagrams(side.node.report_refusals(side.peer, refused, now))


# The record.


def test_encoding_is_the_documented_one() -> None:
    """Byte by byte, as the specification draws it: 1 to 16 whole entries, which fit the smallest envelope."""
    encoded = RefusalReport((ARM, Refused(0x123456, 0, 255, MAX_TOTAL))).encode()
    assert encoded.hex(" ") == "06 00 00 4c 01 90 04 00 00 00 01 12 34 56 00 00 ff ff ff ff ff"
    assert encoded == refusal_report(ARM, (0x123456, 0, 255, MAX_TOTAL))
    valid = [size for size in range(1, 182) if parse_report(bytes((6,)) + bytes(size - 1)) is not None]
    assert valid == [1 + 10 * count for count in range(1, c.REFUSALS_PER_REPORT + 1)]
    assert valid[-1] <= c.MIN_ENVELOPE_LIMIT - 39


# The sender.


def test_changes_are_reported_twice_at_an_interval() -> None:
    """Without new totals there is no report; however fast they grow, a peer gets one per interval."""
    own = OwnRefusals()
    own.update([])
    assert own.take(0.0) is None
    sent = []
    for second in range(0, 60, 2):
        own.update([ARM])
        sent.append(own.take(float(second)))
    assert len([one for one in sent if one is not None]) == c.REFUSALS_SENDS
    moments = []
    for tenth in range(1000, 1200):
        own.update([ARM._replace(total=tenth)])
        if own.take(tenth / 10) is not None:
            moments.append(tenth / 10)
    assert moments == [100.0 + 2.0 * number for number in range(10)]


def test_a_report_has_the_oldest_changes() -> None:
    """What does not fit into one report is in the next one."""
    own = OwnRefusals()
    own.update(kinds(20))
    reported = [totals(own.take(now)) for now in (0.0, 2.0, 4.0)]
    first, rest = [(number, 1) for number in range(16)], [(number, 1) for number in range(16, 20)]
    assert reported == [first, first, rest]


def test_memory_of_the_sender_is_bounded() -> None:
    """The kind that changed longest ago is forgotten. A total above 32 bits is the greatest one."""
    own = OwnRefusals()
    own.update(kinds(c.REFUSALS_KEPT))
    own.update([Refused(0, 0, 2, 2), Refused(9999, 0, 2, 1)])  # 0 changed again: 1 is now the oldest
    assert len(own._totals) == c.REFUSALS_KEPT
    assert [(number, 0, 2) in own._totals for number in (0, 1)] == [True, False]
    own = OwnRefusals()
    own.update([ARM._replace(total=2**40)])
    assert [totals(own.take(now)) for now in (0.0, 2.0)] == [[(76, MAX_TOTAL)]] * 2
    own.update([ARM._replace(total=2**41)])
    assert own.take(4.0) is None


def test_report_needs_a_session_that_can_seal() -> None:
    """What is refused without one is reported when there is a session. A lost report is repeated."""
    pair = Pair()
    assert report(pair.b, 0.0, ARM) == []
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
    before = peer.traffic.bytes_sent
    sent = only(of(pair.b.node.report_refusals(peer, [ARM], 1.0), Transmit))
    assert sent.path == AT_A
    assert unsealed(pair.a.session, sent.datagram) == RefusalReport((ARM,)).encode()
    assert peer.traffic.bytes_sent == before + len(sent.datagram)
    assert peer.unanswered_since is None
    assert peer.timers.deadlines[Timer.SILENCE] == c.NEVER
    assert pair.a.receive(sent.datagram, 1.0) == []


# The feature bit.


@pytest.mark.parametrize(("ours", "theirs"), [(1, 0), (0, 1), (0, 0)])
def test_both_ends_must_agree(ours: int, theirs: int) -> None:
    """Without the bit of either end no report is sent, and one that arrives is invalid."""
    pair = Pair(link_a=quiet(features=ours), link_b=quiet(features=theirs)).establish()
    assert pair.a.session.parameters.features == pair.b.session.parameters.features == 0
    assert report(pair.a, 1.0, ARM) == report(pair.b, 1.0, ARM) == []
    uninvited = pair.a.envelope(1.0, RefusalReport((ARM,)).encode())
    assert reasons(pair.b.receive(uninvited, 1.0)) == [DropReason.BAD_CONTROL]
    assert claims(pair.b) == []
    assert pair.carries(1.0)


# The receiver.


def test_claims_are_bounded_and_repeated_ones_keep_their_time() -> None:
    """A peer replaces its own claims. Only a change is new, such as a smaller total after a restart."""
    kept = RefusalClaims()
    for now, total in ((1.0, 5), (3.0, 5), (5.0, 2)):
        kept.note(RefusalReport((ARM._replace(total=total),)), now)
        (claim,) = kept.recent()
        assert (claim.refused.total, claim.changed_at) == (total, 1.0 if now < 5 else 5.0)
    for number in range(1000, 2000):
        kept.note(RefusalReport((Refused(number, 0, 2, 1),)), float(number))
    assert [claim.refused.message for claim in kept.recent()] == [*range(1999, 1999 - c.REFUSALS_KEPT, -1)]


def test_a_claim_changes_nothing_else() -> None:
    """A flood of claims leaves the receiver as keepalives would: only the claims, in bounded memory, are added."""
    pair, twin = Pair().establish(), Pair().establish()
    for number in range(500):
        entries = tuple(Refused(number * 16 + place, 400, 4, 9) for place in range(16))
        assert pair.b.receive(pair.a.envelope(1.0, RefusalReport(entries).encode()), 1.0) == []
        twin.b.receive(twin.a.envelope(1.0, b""), 1.0)
    assert len(claims(pair.b)) == c.REFUSALS_KEPT
    pair.b.peer.traffic.bytes_received = twin.b.peer.traffic.bytes_received
    for name in ("timers", "traffic", "path", "is_up", "received_at", "unanswered_since", "own_refusals"):
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
    """On an idle link nearly every report comes so. The newest one of several is kept."""
    pair, later = Pair().establish(), 3 * c.LATE_AFTER_S
    newer = ARM._replace(total=ARM.total + 1)
    first, second = (only(report(pair.b, later + after_s, entry)) for after_s, entry in ((0.0, ARM), (2.0, newer)))
    now = later + 2.0 + arrives_after_s
    arrived = [second, first]
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
