"""The longest envelope of a path: found by padded probes."""

from __future__ import annotations

import pytest

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.envelope_limit import EnvelopeLimit

LONGEST = 1232


def search(answers_up_to: int) -> tuple[EnvelopeLimit, list[int]]:
    """A limit after the tests of a path that carries envelopes up to this length; short questions are answered."""
    limit, sizes, now = EnvelopeLimit(), [], 10.0
    limit.begin(now)
    while limit.next_at != NEVER:
        now = limit.next_at
        size = limit.size_to_test(LONGEST, answered_at=now - 0.1, now=now)
        if not size:
            continue
        sizes.append(size)
        limit.asked(len(sizes), now)
        if size <= answers_up_to:
            limit.receive_answer(len(sizes))
    return limit, sizes


def test_a_path_is_not_tested_before_it_is_proved() -> None:
    """A new path gets no long probe."""
    assert EnvelopeLimit().size_to_test(LONGEST, answered_at=0.0, now=1e9) == 0


@pytest.mark.parametrize(
    ("carries", "result", "sizes"),
    [
        (LONGEST, c.MAX_ENVELOPE_LIMIT, [LONGEST]),
        (600, 548, [LONGEST] * c.LIMIT_TESTS + [548]),
        (400, 320, [LONGEST] * c.LIMIT_TESTS + [548] * c.LIMIT_TESTS),
    ],
)
def test_the_limit_is_lowered_until_tests_are_answered(carries: int, result: int, sizes: list[int]) -> None:
    """The session's length, then 548 bytes, then 320; the last one needs no test."""
    limit, sent = search(carries)
    assert (limit.limit, sent) == (result, sizes)


def test_a_path_that_answers_nothing_keeps_its_limit() -> None:
    """Without an answer to a short question, the silence says nothing about length."""
    limit = EnvelopeLimit()
    limit.begin(0.0)
    for number in range(1, 10):
        assert limit.size_to_test(LONGEST, answered_at=-1.0, now=float(number)) == LONGEST
        limit.asked(number, float(number))
    assert limit.limit == c.MAX_ENVELOPE_LIMIT


def test_tests_are_a_second_apart() -> None:
    """A test is not repeated before its answer had time to arrive."""
    limit = EnvelopeLimit()
    limit.begin(0.0)
    assert limit.size_to_test(LONGEST, answered_at=0.0, now=0.0) == LONGEST
    limit.asked(1, 0.0)
    assert limit.size_to_test(LONGEST, answered_at=0.5, now=c.LIMIT_TEST_S - 0.01) == 0
    assert limit.size_to_test(LONGEST, answered_at=0.5, now=c.LIMIT_TEST_S) == LONGEST


def test_a_changed_network_is_tested_again() -> None:
    """A lower limit does not outlive the network that needed it."""
    limit, _ = search(400)
    limit.begin(100.0)
    assert limit.limit == c.MAX_ENVELOPE_LIMIT
    assert limit.size_to_test(LONGEST, answered_at=99.0, now=100.0) == LONGEST


def test_session_with_the_shortest_envelopes_ends_the_search() -> None:
    """The peer came back with a limit of 320 bytes while longer tests were not answered."""
    limit = EnvelopeLimit()
    limit.begin(0.0)
    for number in range(c.LIMIT_TESTS):
        now = float(number)
        assert limit.size_to_test(LONGEST, answered_at=now - 0.1, now=now) == LONGEST
        limit.asked(number + 1, now)
    assert limit.size_to_test(c.MIN_ENVELOPE_LIMIT, answered_at=2.5, now=float(c.LIMIT_TESTS)) == 0
    assert limit.limit == c.MIN_ENVELOPE_LIMIT
    assert limit.next_at == NEVER
