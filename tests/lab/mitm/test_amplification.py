"""An answer larger than its request is detected, also after unanswered requests."""

from __future__ import annotations

import pytest

from uavlinkd.lab.mitm.amplification import CREDIT_S, Amplification


def excess(back: int, *, questions: int, at: float = 0.0, answered_at: float = 0.01) -> int:
    """Of a peer that sends so many bytes back after so many questions of a hundred bytes."""
    amplification = Amplification()
    for number in range(questions):
        amplification.sent("drone0", 3, 100, at + number / 1000)
    amplification.received("drone0", 3, back, answered_at)
    return amplification.excess["drone0", 3]


@pytest.mark.parametrize(("back", "result"), [(0, 0), (100, 0), (101, 1), (200, 100)])
def test_one_question_is_worth_its_own_size(back: int, result: int) -> None:
    """An answer as long as the request is not an amplification; one byte more is."""
    assert excess(back, questions=1) == result


def test_what_was_not_answered_long_ago_hides_nothing() -> None:
    """A thousand questions were not answered; the next one's answer is twice its size, and is found."""
    amplification = Amplification()
    for number in range(1000):
        amplification.sent("drone0", 3, 100, number / 1000)
    amplification.sent("drone0", 3, 100, 1.0 + CREDIT_S)
    amplification.received("drone0", 3, 200, 1.01 + CREDIT_S)
    assert amplification.excess == {("drone0", 3): 100}


def test_strangers_and_peers_are_distinguished() -> None:
    """The bytes of one stranger are not a credit for another stranger or peer."""
    amplification = Amplification()
    amplification.sent("drone0", 3, 100, 0.0)
    amplification.received("drone0", 4, 60, 0.1)
    amplification.received("drone1", 3, 70, 0.1)
    assert amplification.excess == {("drone0", 4): 60, ("drone1", 3): 70}


def test_several_answers_share_what_was_sent() -> None:
    """Two of sixty bytes are too much for one question of a hundred, and not for two."""
    for questions, result in ((1, 20), (2, 0)):
        amplification = Amplification()
        for _ in range(questions):
            amplification.sent("drone0", 3, 100, 0.0)
        for _ in range(2):
            amplification.received("drone0", 3, 60, 0.1)
        assert amplification.excess.total() == result


def test_an_answer_may_take_so_long_and_no_longer() -> None:
    """After that the question is forgotten."""
    assert excess(100, questions=1, answered_at=CREDIT_S) == 0
    assert excess(100, questions=1, answered_at=CREDIT_S + 0.01) == 100
