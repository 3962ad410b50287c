"""When a relay is asked about other members."""

from __future__ import annotations

import random

import pytest

from uavlinkd.authority.constants import CERTIFICATES_PER_ANSWER, CERTIFIED_PEERS, WHO, WHO_INTERVAL_S
from uavlinkd.fleet.member_questions import WHO_ROUNDS, WHO_TRIES, MemberQuestions

RELAY = bytes(32)


def asked(questions: MemberQuestions, until: float, members: int, loss: float = 0.0) -> tuple[list[float], set[int]]:
    """When a relay with so many members was asked, and the serials of which the answers arrived."""
    at: list[float] = []
    known: set[int] = set()
    rng = random.Random(1)
    while (now := questions.next_at) <= until:
        for relay, who in list(questions.pop_due(4, now)):
            at.append(now)
            if rng.random() < loss:
                continue
            for serial in range(who.after + 1, min(who.after + CERTIFICATES_PER_ANSWER, members) + 1):
                if rng.random() >= loss:
                    questions.note(relay, serial, now)
                    if serial not in known:
                        questions.found(relay)
                    known.add(serial)
    return at, known


@pytest.mark.parametrize(
    ("members", "loss", "within_s"), [(1, 0.0, 0.0), (CERTIFIED_PEERS - 1, 0.0, 0.0), (9, 0.3, 2.0), (50, 0.1, 4.0)]
)
def test_all_members_are_soon_known(members: int, loss: float, within_s: float) -> None:
    """One round is enough without loss, also for a full relay within its limit of questions; later ones are rare."""
    questions = MemberQuestions()
    questions.begin(RELAY, 0.0)
    at, known = asked(questions, within_s, members, loss)
    assert len(known) == members
    assert loss or len(at) <= WHO.burst
    asked(questions, WHO_INTERVAL_S, members)
    assert questions.next_at > WHO_INTERVAL_S
    questions.note(RELAY, members + 1, WHO_INTERVAL_S)  # an introduction
    later, _ = asked(questions, 3 * WHO_INTERVAL_S, members)
    assert len(later) <= 2 * WHO_ROUNDS * (members // CERTIFICATES_PER_ANSWER + WHO_TRIES + 1)
    questions.begin(RELAY, 3 * WHO_INTERVAL_S)  # a new session with it
    assert questions.next_at > 3 * WHO_INTERVAL_S
    questions.end(RELAY)
    assert asked(questions, 9e9, members) == ([], set())
