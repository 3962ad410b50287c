"""Questions to candidates: how many, what their answers change, and that nothing else does."""

from __future__ import annotations

import pytest

from tests.protocol.harness import Pair, exchange, of, only, probe_in, quiet, reasons
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import PathChanged, Transmit
from uavlinkd.protocol.path import Path, relayed

LINK = quiet(features=c.FEATURE_RECORDS)
DIRECT = Path(0, ("198.51.100.9", 4001))
"""Where bravo is, as alpha sees it without a relay; the same the other way."""
HOME = Path(0, ("198.51.100.8", 4000))


def at(number: int) -> Path:
    """Another candidate."""
    return Path(0, (f"203.0.113.{number}", 4000))


@pytest.fixture
def pair() -> Pair:
    """Linked along a relay, which is fast."""
    made = Pair(LINK, LINK)
    made.a.peer_at, made.b.peer_at = relayed(0, "vps", 7), relayed(0, "vps", 8)
    for side in (made.a, made.b):
        side.configure_path(0.0)
    made.establish()
    assert made.carries(0.0)
    return made


def ask(pair: Pair, now: float, *paths: Path) -> list[Transmit]:
    """Alpha's questions to these candidates. Those along the relay do not arrive."""
    return [sent for sent in ask_everywhere(pair, now, *paths) if not sent.path.is_relayed]


def ask_everywhere(pair: Pair, now: float, *paths: Path) -> list[Transmit]:
    """The same, with the question along the relay if one is due."""
    pair.a.peer.paths.set_candidates(paths)
    return of(pair.a.node.ask_candidates(pair.a.peer, now), Transmit)


def answered(pair: Pair) -> Transmit:
    """Bravo's answer to a question of alpha to the address where it is."""
    question = only(ask(pair, 1.0, DIRECT)).datagram
    return only(of(pair.b.node.receive(question, HOME, 1.0), Transmit))


def answer_along_relay(pair: Pair, sent: list[Transmit], now: float) -> int:
    """Let bravo answer what goes along the relay. Returns how many questions that is."""
    along = [transmit for transmit in sent if transmit.path.is_relayed]
    exchange(pair.b, pair.a, [*along], now)
    return len(along)


def test_each_candidate_gets_one_question_and_no_slot(pair: Pair) -> None:
    """Short, and each another one. It carries nothing. Nothing is asked without a session."""
    sent = ask(pair, 1.0, DIRECT, at(1))
    assert [transmit.path for transmit in sent] == [DIRECT, at(1)]
    questions = {probe_in(pair.b, transmit.datagram).question for transmit in sent}
    assert len(questions) == 2
    assert 0 not in questions
    assert max(len(transmit.datagram) for transmit in sent) < 50
    assert pair.a.peer.paths.find(DIRECT) is None
    assert {transmit.path for transmit in of(pair.a.send(1.0), Transmit)} == {pair.a.peer_at}
    assert ask(Pair(LINK, LINK), 0.0, DIRECT) == []


def test_questions_to_candidates_are_in_the_totals_of_the_peer(pair: Pair) -> None:
    """Its budget pays for them, also when another address takes a candidate's place, or it becomes a path."""
    paths = pair.a.peer.paths
    before = paths.totals
    sent = ask_everywhere(pair, 1.0, DIRECT, at(1))
    sent += ask_everywhere(pair, 2.0, DIRECT, at(2))
    size = sum(len(transmit.datagram) for transmit in sent)
    assert len(sent) >= 3
    assert paths.totals[:2] == (before.datagrams_sent + len(sent), before.bytes_sent + size)
    paths.learn(DIRECT, 3.0)
    assert paths.totals[:2] == (before.datagrams_sent + len(sent), before.bytes_sent + size)


def test_answered_candidate_becomes_the_best_path(pair: Pair) -> None:
    """At both ends: bravo learns it by the question, and asks in its answer. Its probes ask it from then on."""
    answer = answered(pair)
    assert answer.path == HOME
    outputs = pair.a.node.receive(answer.datagram, DIRECT, 1.01)
    assert pair.a.peer.paths.by_path[DIRECT].is_validated
    assert [changed.path for changed in of(outputs, PathChanged)] == [DIRECT]
    back = next(sent for sent in of(outputs, Transmit) if sent.path == DIRECT)
    outputs = pair.b.node.receive(back.datagram, HOME, 1.02)
    assert [changed.path for changed in of(outputs, PathChanged)] == [HOME]
    assert ask(pair, 1.1, DIRECT, at(1))[0].path == at(1)


def test_answer_from_elsewhere_is_asked_there(pair: Pair) -> None:
    """A symmetric NAT: bravo's answer comes from a port that is in no list."""
    outputs = pair.a.node.receive(answered(pair).datagram, at(5), 1.01)
    assert DropReason.UNEXPECTED_ANSWER in reasons(outputs)
    assert pair.a.peer.paths.find(DIRECT) is None
    assert not pair.a.peer.paths.by_path[at(5)].is_validated
    assert at(5) in {sent.path for sent in of(outputs, Transmit)}


def test_peer_that_names_victims_causes_a_bounded_number_of_questions(pair: Pair) -> None:
    """Whatever lists it sends: eight candidates count, and 80 questions at once, then one a second."""
    sent = ask(pair, 1.0, at(1), at(1), *(at(number) for number in range(1, 20)))
    assert [transmit.path for transmit in sent] == [at(number) for number in range(1, 9)]
    at_once = 8 + sum(len(ask(pair, 1.0, *(at(16 * round_ + n) for n in range(16)))) for round_ in range(15))
    assert at_once == c.CANDIDATE_QUESTIONS
    later = sum(len(ask(pair, now / 10, at(now % 200), at(now % 200 + 1))) for now in range(20, 120))
    assert later == pytest.approx(10 * c.CANDIDATE_QUESTIONS_PER_S, abs=1)


def test_questions_in_vain_are_not_a_loss_of_the_path(pair: Pair) -> None:
    """Otherwise a search would start repair. What the path itself loses is a loss."""
    best = pair.a.peer.paths.best
    assert best is not None
    for now in (1.0, 2.0, 3.0):
        exchange(pair.b, pair.a, pair.a.node.ask(pair.a.peer, best.path, now), now)
        sent = ask_everywhere(pair, now, *map(at, range(8)))
        assert len(sent) == 8 + answer_along_relay(pair, sent, now)
    assert best.loss_to_repair() == (0.0, 0)
    pair.a.send(3.5)
    exchange(pair.b, pair.a, pair.a.node.ask(pair.a.peer, best.path, 4.0), 4.0)
    assert best.loss_to_repair()[1] == 1


def test_only_path_is_asked_while_candidates_are(pair: Pair) -> None:
    """One question each 5 s, until no further round can follow: its counts show the peer that gaps are not losses."""
    asked = []
    for step in range(200):
        now = step / 2
        sent = ask_everywhere(pair, now, DIRECT) if now in (20.0, 21.0) else of(pair.a.timeout(now), Transmit)
        asked += [now] * answer_along_relay(pair, sent, now)
    ends = 21.0 + c.CANDIDATE_ROUND_MOST_S
    assert asked == [20.0 + c.PROBE_INTERVAL_S * number for number in range(100) if 5 * number + 20 < ends]


def test_question_of_an_older_session_does_not_delay_that_of_a_new_one(pair: Pair) -> None:
    """The peer knows no counts of the new one yet."""
    rekey_at = pair.a.session.created_at + pair.a.peer.durations.rekey_after_s
    assert answer_along_relay(pair, ask_everywhere(pair, rekey_at - 1.0, DIRECT), rekey_at - 1.0) == 1
    before = pair.a.session
    pair.establish(rekey_at)
    assert pair.a.session is not before
    assert answer_along_relay(pair, ask_everywhere(pair, rekey_at + 1.0, DIRECT), rekey_at + 1.0) == 1
