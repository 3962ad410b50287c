"""When a relay is asked about other members."""

from __future__ import annotations

from uavlinkd.authority.constants import CERTIFICATES_PER_ANSWER, WHO_INTERVAL_S
from uavlinkd.link.member_questions import MemberQuestions

RELAY = bytes(32)


def asked(questions: MemberQuestions, until: float, members: int) -> list[tuple[float, int]]:
    """When a relay with so many members was asked, and from which serial on."""
    seen: list[tuple[float, int]] = []
    while (now := questions.next_at) <= until:
        for relay, who in list(questions.pop_due(4, now)):
            seen.append((now, who.after))
            for serial in range(who.after + 1, min(who.after + CERTIFICATES_PER_ANSWER, members) + 1):
                questions.note(relay, serial, now)
    return seen


def test_questions_are_rare_after_an_answer() -> None:
    """All pages at once, and then in two minutes; without an answer at growing intervals; exactly one page too."""
    for members, first in ((3, [0]), (20, [0, 8, 16]), (0, [0] * 8)):
        questions = MemberQuestions()
        questions.begin(RELAY, 0.0)
        assert [after for _, after in asked(questions, WHO_INTERVAL_S - 1, members)] == first
    questions = MemberQuestions()
    questions.begin(RELAY, 0.0)
    assert len(asked(questions, WHO_INTERVAL_S, 8)) <= 16
    questions.end(RELAY)
    assert asked(questions, 9e9, 8) == []
