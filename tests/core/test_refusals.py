"""Refusal reports: what is sent and when, what a receiver keeps, and that nothing acts on a claim."""

from __future__ import annotations

import pytest

from tests.core.harness import (
    AT_A,
    ELSEWHERE,
    Pair,
    Side,
    datagrams,
    flipped,
    only,
    quiet,
    reasons,
    state_of,
    unsealed,
)
from tests.core.independent import Parameters as OtherParameters
from tests.core.independent import refusal_report
from tests.core.test_independent import HERE
from tests.core.test_independent import Pair as MixedPair
from uavlinkd.core import constants as c
from uavlinkd.core import establish
from uavlinkd.core.drops import DropReason
from uavlinkd.core.refusals import MAX_TOTAL, OwnRefusals, RefusalClaims, RefusalReport, Refused, parse_report
from uavlinkd.core.timers import Timer

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
    """Byte by byte, as the specification draws it."""
    encoded = RefusalReport((ARM, Refused(0x123456, 0, 255, MAX_TOTAL))).encode()
    assert encoded.hex(" ") == "06 00 00 4c 01 90 04 00 00 00 01 12 34 56 00 00 ff ff ff ff ff"
    assert encoded == refusal_report(ARM, (0x123456, 0, 255, MAX_TOTAL))


@pytest.mark.parametrize("size", sorted({*range(172)} - {1 + 10 * count for count in range(1, 17)}))
def test_other_lengths_are_invalid(size: int) -> None:
    """A report has 1 to 16 whole entries."""
    assert parse_report(bytes((6,)) + bytes(max(0, size - 1))) is None


def test_largest_report_fits_the_smallest_envelope() -> None:
    """It is never too large for a peer."""
    largest = RefusalReport(tuple(kinds(c.REFUSALS_PER_REPORT))).encode()
    assert len(largest) <= c.MIN_ENVELOPE_LIMIT - 39


# The sender.


def test_nothing_new_is_not_reported() -> None:
    """Without refusals there is no report, and an unchanged total is reported a fixed number of times."""
    own = OwnRefusals()
    own.update([])
    assert own.take(0.0) is None
    sent = 0
    for second in range(0, 60, 2):
        own.update([ARM])
        sent += own.take(float(second)) is not None
    assert sent == c.REFUSALS_SENDS


def test_reports_have_an_interval() -> None:
    """However fast totals grow, a peer gets one report per interval."""
    own = OwnRefusals()
    sent = []
    for tenth in range(200):
        own.update([ARM._replace(total=tenth + 1)])
        if own.take(tenth / 10) is not None:
            sent.append(tenth / 10)
    assert sent == [2.0 * number for number in range(10)]


def test_a_report_has_the_oldest_changes() -> None:
    """What does not fit into one report is in the next one."""
    own = OwnRefusals()
    own.update(kinds(20))
    first = totals(own.take(0.0))
    second = totals(own.take(2.0))
    third = totals(own.take(4.0))
    assert first == [(number, 1) for number in range(16)]
    assert second == first
    assert third == [(number, 1) for number in range(16, 20)]


def test_kinds_are_bounded_at_the_sender() -> None:
    """The kind that changed longest ago is forgotten."""
    own = OwnRefusals()
    own.update(kinds(c.REFUSALS_KEPT))
    own.update([Refused(0, 0, 2, 2), Refused(9999, 0, 2, 1)])  # 0 changed again: 1 is now the oldest
    assert len(own._totals) == c.REFUSALS_KEPT
    assert (1, 0, 2) not in own._totals
    assert (0, 0, 2) in own._totals


def test_totals_saturate() -> None:
    """A total above 32 bits is reported as the greatest one, and does not change any more."""
    own = OwnRefusals()
    own.update([ARM._replace(total=2**40)])
    assert totals(own.take(0.0)) == [(76, MAX_TOTAL)]
    own.take(2.0)
    own.update([ARM._replace(total=2**41)])
    assert own.take(4.0) is None


def test_no_session_no_report() -> None:
    """What is refused meanwhile is reported when there is a session."""
    pair = Pair()
    assert report(pair.b, 0.0, ARM) == []
    pair.establish()
    pair.a.receive(only(report(pair.b, 1.0)), 1.0)
    assert claims(pair.a) == [ARM]


def test_report_on_a_session_that_can_seal_no_more() -> None:
    """Expired or used-up keys seal nothing."""
    pair = Pair().establish()
    assert report(pair.b, 500.0, ARM) == []
    pair.b.session.send_counter = c.SESSION_ENVELOPE_LIMIT
    assert report(pair.b, 1.0, ARM) == []


def test_a_report_asks_for_nothing() -> None:
    """It does not start the timers of a silence, so two ends cannot keep each other busy."""
    pair = Pair().establish()
    pair.b.peer.unanswered_since = None
    pair.b.peer.timers.stop(Timer.SILENCE)
    (datagram,) = report(pair.b, 1.0, ARM)
    assert pair.b.peer.unanswered_since is None
    assert pair.b.peer.timers.deadlines[Timer.SILENCE] == c.NEVER
    assert pair.a.receive(datagram, 1.0) == []


def test_budget_is_charged() -> None:
    """The bytes of a report count as those of any datagram to the peer."""
    pair = Pair().establish()
    before = pair.b.peer.traffic.bytes_sent
    (datagram,) = report(pair.b, 1.0, ARM)
    assert pair.b.peer.traffic.bytes_sent == before + len(datagram)


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


def test_an_older_implementation_links_and_gets_no_report() -> None:
    """The second implementation without features: as before."""
    mixed = MixedPair()
    linked = mixed.link()
    assert linked.parameters.features == 0
    assert mixed.node.report_refusals(mixed.peer, [ARM], 1.0) == []


def test_an_independent_implementation_reads_and_writes_reports() -> None:
    """What the specification says is enough."""
    mixed = MixedPair()
    linked = mixed.link(parameters=OtherParameters(features=0xFFFF))
    assert linked.parameters.features & 1
    (datagram,) = datagrams(mixed.node.report_refusals(mixed.peer, [ARM, HEARTBEAT], 1.0))
    assert linked.open(datagram) == refusal_report(ARM, HEARTBEAT)
    assert mixed.node.receive(linked.seal(refusal_report(HEARTBEAT)), HERE, 1.0) == []
    assert [claim.refused for claim in mixed.peer.refusal_claims.recent()] == [HEARTBEAT]


def test_a_removed_bit_fails_the_handshake() -> None:
    """Features are inside the sealed payload: an attacker cannot make two ends agree on fewer."""
    pair = Pair()
    initiation = pair.initiation(0.0)
    for position in range(len(initiation) - 32 - 31, len(initiation) - 32):
        assert not datagrams(Pair().b.receive(flipped(initiation, position), 0.0), 2)


# The receiver.


def test_claims_are_bounded() -> None:
    """A peer that reports ever other kinds replaces its own claims."""
    kept = RefusalClaims()
    for number in range(1000):
        kept.note(RefusalReport((Refused(number, 0, 2, 1),)), float(number))
    recent = kept.recent()
    assert [claim.refused.message for claim in recent] == [*range(999, 999 - c.REFUSALS_KEPT, -1)]


def test_repeated_claim_keeps_its_time() -> None:
    """Only a change is new; a smaller total, after the peer's restart, is a change."""
    kept = RefusalClaims()
    for now, total in ((1.0, 5), (3.0, 5), (5.0, 2)):
        kept.note(RefusalReport((ARM._replace(total=total),)), now)
        (claim,) = kept.recent()
        assert (claim.refused.total, claim.changed_at) == (total, 1.0 if now < 5 else 5.0)


def test_a_lost_report_is_repeated() -> None:
    """One refused command is reported twice, so one lost datagram does not hide it."""
    pair = Pair().establish()
    assert report(pair.b, 1.0, ARM)
    pair.a.receive(pair.b.envelope(2.0), 2.0)
    pair.a.receive(only(report(pair.b, 3.0, ARM)), 3.0)
    assert claims(pair.a) == [ARM]
    assert report(pair.b, 5.0, ARM) == []


@pytest.mark.parametrize("confidential", [False, True])
def test_replayed_altered_and_forged_reports(confidential: bool) -> None:
    """Nothing that a network attacker makes of a report changes what the receiver knows."""
    link = quiet(confidential=confidential)
    pair = Pair(link_a=link, link_b=link).establish()
    (datagram,) = report(pair.b, 1.0, ARM)
    before = state_of(pair.a.node)
    for position in range(5, len(datagram)):
        assert reasons(pair.a.receive(flipped(datagram, position), 1.0)) == [DropReason.BAD_TAG]
    assert state_of(pair.a.node) == before
    pair.a.receive(datagram, 1.0, ELSEWHERE)
    assert claims(pair.a) == [ARM]
    assert pair.a.receive(datagram, 1.0) == []
    assert pair.a.peer.traffic.drops[DropReason.DUPLICATE] == 1
    assert claims(pair.a) == [ARM]


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


def test_report_goes_where_the_traffic_goes() -> None:
    """It uses the path of the traffic, whatever path the refused frames used."""
    pair = Pair().establish()
    pair.b.receive(pair.a.envelope(1.0), 1.0, ELSEWHERE)
    assert [out.path for out in pair.b.node.report_refusals(pair.b.peer, [ARM], 1.0)] == [AT_A]  # type: ignore[union-attr]
    assert unsealed(pair.a.session, only(report(pair.b, 3.0))) == RefusalReport((ARM,)).encode()


def test_an_old_report_changes_nothing() -> None:
    """Neither one that arrives after a silence, nor one of a session that another one replaced."""
    pair = Pair().establish()
    held_back = only(report(pair.b, 0.5, ARM))
    pair.a.receive(held_back, 0.5 + 2 * c.LATE_AFTER_S)
    assert claims(pair.a) == []

    pair = Pair().establish()
    held_back = only(report(pair.b, 0.5, ARM))
    initiation = only(datagrams(establish.initiate(pair.a.peer, 1.0)))
    response = only(datagrams(pair.b.receive(initiation, 1.0)))
    pair.b.receive(only(datagrams(pair.a.receive(response, 1.0))), 1.0)
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
    if arrives_after_s:
        pair.b.timeout(now)
        pair.a.receive(pair.b.envelope(now), now)  # an empty one comes before: all below it is old
    questions = datagrams(pair.a.receive(second, now)) + datagrams(pair.a.receive(first, now))
    assert claims(pair.a) == []
    answers = [answer for question in questions for answer in datagrams(pair.b.receive(question, now + 0.1))]
    for answer in answers:
        pair.a.receive(answer, now + 0.2)
    assert claims(pair.a) == ([newer] if counts else [])
