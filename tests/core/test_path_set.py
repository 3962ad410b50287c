"""The paths to a peer: slots, the best one, the route of each class, and how often each path is asked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set as AbstractSet

import pytest

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.paths import BestChanged, Change, ConditionChanged, PathSet
from uavlinkd.core.probe import Probe
from uavlinkd.core.settings import Class, Redundancy
from uavlinkd.core.socket_facts import SocketFacts

LTE, MESH, SIK = (Path(number, (f"192.0.2.{number + 1}", 5790)) for number in range(3))
PLACES = [Path(0, (f"203.0.113.{number}", 4000)) for number in range(1, 9)]


def path_set(
    *paths: Path,
    redundancy: Redundancy = Redundancy.CRITICAL,
    idle_probe_s: float = c.PROBE_IDLE_S,
    metered: AbstractSet[int] = frozenset(),
    known: Counter[SocketAddress] | None = None,
) -> PathSet:
    """A set with these configured paths."""
    made = PathSet(redundancy, idle_probe_s, Counter() if known is None else known, SocketFacts(metered))
    made.configure(paths, 0.0)
    return made


def of(paths: PathSet, path: Path) -> PathState:
    """The slot of a path."""
    state = paths.find(path)
    assert state is not None
    return state


def answer(paths: PathSet, path: Path, now: float, round_trip_s: float = 0.1) -> list[Change]:
    """A question along a path is answered."""
    state = of(paths, path)
    question = round(now * 1000) + 1
    state.make_probe(question, 0, now - round_trip_s)
    is_first = not state.is_validated
    assert state.receive_answer(question, state.sent, now) is not None
    paths.note_answer(state, now, is_first=is_first)
    return paths.update(now)


def fail(paths: PathSet, path: Path, now: float) -> list[Change]:
    """Two questions along a path get no answer, until then."""
    state = of(paths, path)
    for question, before_s in ((1, 2.0), (2, 1.5)):
        state.make_probe(question, 0, now - before_s)
    return paths.update(now)


def suspect(paths: PathSet, path: Path, now: float) -> list[Change]:
    """One question along a path gets no answer, until then."""
    of(paths, path).make_probe(3, 0, now - 0.9)
    changes = paths.update(now)
    assert of(paths, path).condition is PathCondition.SUSPECT
    return changes


def linked(*paths: Path, **settings: object) -> PathSet:
    """A set of usable paths at second 1, the first one the best; the others are slower, in their order."""
    made = path_set(*paths, **settings)  # type: ignore[arg-type]
    made.prefer(paths[0], 0.5)
    made.active_at = 1.0
    for number, path in enumerate(paths):
        answer(made, path, 1.0, 0.05 * (number + 1))
        of(made, path).answers = c.SETTLING_ANSWERS
    return made


def route(paths: PathSet, cls: Class) -> list[Path]:
    """Where frames of a class go."""
    return [state.path for state in paths.routes[cls]]


# Slots.


def test_eight_configured_paths_have_slots() -> None:
    """Further ones are ignored."""
    many = [Path(number, ("192.0.2.1", 5790)) for number in range(12)]

    assert path_set(*many).configured == tuple(many[: c.CONFIGURED_PATHS])


def test_two_paths_to_one_host_along_one_socket_have_slots() -> None:
    """A host with many ports does not take the slots of others; along another socket it has two more."""
    same = [Path(0, ("192.0.2.1", port)) for port in (1, 2, 3)]
    other = Path(1, ("192.0.2.1", 3))

    assert path_set(*same, other).configured == (*same[: c.PATHS_PER_HOST], other)


def test_configured_twice_is_one_path() -> None:
    """A name and an address may mean the same."""
    assert path_set(LTE, MESH, LTE).configured == (LTE, MESH)


def test_learned_path_that_is_configured_keeps_its_state() -> None:
    """It needs no proof again."""
    paths = path_set()
    paths.prefer(LTE, 0.0)
    answer(paths, LTE, 1.0)
    paths.configure([MESH, LTE], 2.0)

    assert of(paths, LTE).is_configured
    assert of(paths, LTE).is_validated
    assert paths.configured == (MESH, LTE)


def test_path_that_works_outlives_its_configuration() -> None:
    """As a learned path: a name that resolves to another address does not cut the link."""
    paths = linked(LTE, MESH)
    paths.configure([SIK], 2.0)
    assert [state.path for state in paths.states] == [SIK, LTE, MESH]
    assert paths.configured == (SIK,)

    fail(paths, MESH, 5.0)
    assert paths.find(MESH) is None


def test_unproven_path_goes_with_its_configuration() -> None:
    """There is nothing to keep."""
    paths = path_set(LTE, MESH)
    paths.configure([MESH], 1.0)

    assert paths.find(LTE) is None
    assert not paths.has_several


@pytest.mark.parametrize("kept", ["validated", "working", "recent"])
def test_least_useful_learned_path_makes_room(kept: str) -> None:
    """First one that was never validated, then one that does not work, then the one that was first for longest."""
    paths = path_set(LTE)
    paths.prefer(LTE, 0.0)
    answer(paths, LTE, 0.5)
    for number, place in enumerate(PLACES[: c.LEARNED_PATHS]):
        paths.learn(place, 1.0)
        of(paths, place).received_at = 2.0 + number
        if kept != "validated" or number != 2:
            answer(paths, place, 1.1)
    if kept == "working":
        of(paths, PLACES[3]).set_off(is_off=True, now=2.0)
    paths.learn(PLACES[6], 3.0)

    gone = {"validated": PLACES[2], "working": PLACES[3], "recent": PLACES[0]}[kept]
    assert paths.find(gone) is None
    assert len(paths.states) == 1 + c.LEARNED_PATHS


def test_best_path_never_makes_room() -> None:
    """Not even if it is the only one that was never validated."""
    paths = path_set()
    paths.prefer(PLACES[0], 0.0)
    for place in PLACES[1:4]:
        paths.learn(place, 1.0)
        of(paths, place).answered_at = 1.0
    paths.learn(PLACES[6], 2.0)

    assert paths.find(PLACES[0]) is not None
    assert len(paths.states) == c.LEARNED_PATHS


def test_numbers_of_slots_are_not_shared() -> None:
    """Each slot in use has a number of its own, also after others made room."""
    paths = path_set(LTE, MESH)
    for number, place in enumerate(PLACES):
        paths.learn(place, float(number))
        numbers = [state.number for state in paths.states]
        assert len(set(numbers)) == len(numbers)
        assert all(paths.with_number(state.number) is state for state in paths.states)


def test_only_the_newest_addresses_that_went_down_are_remembered() -> None:
    """A peer that moves often costs no memory."""
    paths, now = path_set(LTE), 0.0
    answer(paths, LTE, now)
    for place in PLACES[: c.LEARNED_PATHS + 1]:
        paths.learn(place, now)
        answer(paths, place, now)
        now += 3.0
        answer(paths, LTE, now)
        fail(paths, place, now)
        while paths.find(place) is not None:
            now += 0.5
            answer(paths, LTE, now)
    assert [paths.was_validated(place, now - 20.0) for place in PLACES[: c.LEARNED_PATHS + 1]] == [
        False,
        *[True] * c.LEARNED_PATHS,
    ]


def test_addresses_where_the_peer_was_are_known() -> None:
    """From the session or the first answer on, until the slot is free."""
    known = Counter[SocketAddress]()
    paths = path_set(LTE, known=known)
    assert not known
    paths.prefer(MESH, 0.0)
    answer(paths, LTE, 1.0)
    assert known == {LTE.address: 1, MESH.address: 1}
    paths.clear()
    assert not known


def test_address_of_two_peers_stays_known_for_the_second() -> None:
    """Two peers behind one relay: the first one is removed."""
    known = Counter[SocketAddress]()
    first, second = path_set(LTE, known=known), path_set(LTE, known=known)
    for paths in (first, second):
        answer(paths, LTE, 1.0)
    first.clear()

    assert known == {LTE.address: 1}


# The best path.


def test_first_answer_makes_the_best_path() -> None:
    """Without a session along a path."""
    paths = path_set(LTE, MESH)
    assert answer(paths, MESH, 1.0) == [ConditionChanged(of(paths, MESH), True, "answered")]

    assert paths.best is of(paths, MESH)


def test_session_along_a_path_makes_it_the_best_unless_the_best_works() -> None:
    """New keys do not change the election."""
    paths = linked(LTE, MESH)
    paths.prefer(MESH, 2.0)
    assert paths.best is of(paths, LTE)

    for path in (LTE, MESH):
        of(paths, path).set_off(is_off=True, now=3.0)
    of(paths, MESH).set_off(is_off=False, now=3.0)
    paths.prefer(MESH, 4.0)
    assert paths.best is of(paths, MESH)
    assert paths.update(4.0)[0] == BestChanged(of(paths, MESH), of(paths, LTE), "session")


def test_session_along_a_slot_from_before_a_silence_is_not_given_up() -> None:
    """No timer looked at the slot while the peer was away. The path has its whole time for an answer again."""
    paths = path_set()
    paths.learn(PLACES[0], 1.0)
    now = 1.0 + 2 * c.FIRST_PATH_S
    best = paths.prefer(PLACES[0], now)
    paths.update(now + c.FIRST_PATH_S - 0.1)
    assert paths.best is best
    paths.update(now + c.FIRST_PATH_S)
    assert paths.best is None


def test_failed_path_is_replaced_at_once() -> None:
    """By the cheapest that works; both changes have their reason."""
    paths = linked(LTE, SIK, MESH)
    of(paths, SIK).srtt_s = 1.0

    assert fail(paths, LTE, 4.0) == [
        BestChanged(of(paths, MESH), of(paths, LTE), "unanswered"),
        ConditionChanged(of(paths, LTE), False, "unanswered"),
    ]


def test_path_whose_network_is_gone_is_replaced_at_once() -> None:
    """Without waiting for questions."""
    paths = linked(LTE, MESH)
    paths.set_socket_state(LTE.socket, 2.0, is_up=False)

    assert paths.update(2.0)[0] == BestChanged(of(paths, MESH), of(paths, LTE), "network")
    assert route(paths, Class.CRITICAL) == [MESH]


def test_failed_path_stays_the_best_while_there_is_no_other() -> None:
    """Frames go along it: it may come back before anything else."""
    paths = linked(LTE, MESH)
    fail(paths, MESH, 4.0)
    fail(paths, LTE, 6.0)

    assert paths.best is of(paths, LTE)
    assert not paths.works
    assert route(paths, Class.STREAM) == [LTE]


def test_usable_path_replaces_a_failed_one_before_a_suspect_one() -> None:
    """Even if the suspect one is faster."""
    paths = linked(LTE, MESH, SIK)
    suspect(paths, MESH, 4.0)
    fail(paths, LTE, 4.0)

    assert paths.best is of(paths, SIK)


def test_recovering_path_is_used_at_once_when_the_last_other_fails() -> None:
    """It need not prove itself for two seconds then."""
    paths = linked(LTE, MESH)
    fail(paths, MESH, 4.0)
    answer(paths, MESH, 5.0)
    assert of(paths, MESH).is_recovering
    changes = fail(paths, LTE, 5.5)

    assert of(paths, MESH).condition is PathCondition.USABLE
    assert paths.best is of(paths, MESH)
    assert BestChanged(of(paths, MESH), of(paths, LTE), "unanswered") in changes


def test_better_path_is_elected_after_two_seconds() -> None:
    """Not before, and the reason is its delay."""
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s = 0.4
    assert paths.update(2.0) == []
    assert paths.next_at <= 2.0 + c.BETTER_FOR_S
    assert paths.update(2.0 + c.BETTER_FOR_S - 0.001) == []

    changes = paths.update(2.0 + c.BETTER_FOR_S)
    assert changes == [BestChanged(of(paths, MESH), of(paths, LTE), "faster")]


def test_path_that_was_better_for_a_moment_is_not_elected() -> None:
    """Its two seconds begin again."""
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s = 0.4
    paths.update(2.0)
    of(paths, LTE).srtt_s = 0.1
    paths.update(3.0)
    of(paths, LTE).srtt_s = 0.4
    paths.update(3.5)

    assert paths.update(2.0 + c.BETTER_FOR_S) == []
    assert len(paths.update(3.5 + c.BETTER_FOR_S)) == 1


@pytest.mark.parametrize(
    ("best_s", "other_s", "is_better"),
    [(0.400, 0.322, False), (0.400, 0.318, True), (0.060, 0.042, False), (0.060, 0.038, True)],
)
def test_better_is_by_a_fifth_and_by_ten_milliseconds(best_s: float, other_s: float, is_better: bool) -> None:
    """Of the one-way delay, half of the round trip: two paths of nearly equal delay do not take turns."""
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s, of(paths, MESH).srtt_s = best_s, other_s
    paths.update(2.0)

    assert bool(paths.update(2.0 + c.BETTER_FOR_S)) == is_better


def test_loss_counts_as_delay() -> None:
    """A hundred milliseconds for each 5 %; the reason names it."""
    paths = linked(LTE, MESH)
    of(paths, MESH).srtt_s = 0.5
    state = of(paths, LTE)
    for number, (sent, received) in enumerate([(1, 1), (101, 71)]):
        state.sent = sent - 1
        state.make_probe(7 + number, 0, 2.0 + number / 2)
        state.receive_answer(7 + number, received, 2.1 + number / 2)
    assert state.loss_out == pytest.approx(0.3, abs=0.02)
    paths.update(2.6)

    assert paths.update(2.6 + c.BETTER_FOR_S) == [BestChanged(of(paths, MESH), state, "loss")]


def test_lag_of_copies_counts_instead_of_the_round_trip() -> None:
    """It compares one-way delays on real traffic: here the path with the longer round trip delivers first."""
    paths = linked(LTE, MESH)
    for now in (2.0, 4.0):
        of(paths, LTE).receive_report(Probe(1, 0, 1, 1, 80), now)
        of(paths, MESH).receive_report(Probe(1, 0, 1, 1, 0), now)
        changes = paths.update(now)

    assert changes == [BestChanged(of(paths, MESH), of(paths, LTE), "faster")]


def test_lag_that_is_not_known_for_each_path_does_not_count() -> None:
    """A lag and a round trip cannot be compared."""
    paths = linked(LTE, MESH)
    for now in (2.0, 4.0):
        of(paths, LTE).receive_report(Probe(1, 0, 1, 1, 80), now)
        assert paths.update(now) == []


def test_suspect_path_is_not_elected() -> None:
    """Reports can only make a path worse."""
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s = 2.0
    paths.update(2.0)
    suspect(paths, MESH, 3.0)

    assert paths.update(2.0 + c.BETTER_FOR_S) == []
    assert paths.best is of(paths, LTE)


# Metered paths.


def test_metered_path_is_the_best_only_without_another() -> None:
    """However fast it is; when another one works again it is replaced at once."""
    paths = linked(MESH, LTE, metered={LTE.socket})
    of(paths, MESH).srtt_s = 3.0
    paths.update(2.0)
    assert paths.update(10.0) == []
    assert paths.role(of(paths, LTE)) == "metered"

    of(paths, MESH).srtt_s = 0.1
    assert fail(paths, MESH, 60.0)[0] == BestChanged(of(paths, LTE), of(paths, MESH), "unanswered")
    assert paths.role(of(paths, LTE)) == "best"
    for number in range(4):
        assert paths.best is of(paths, LTE)
        changes = answer(paths, MESH, 61.0 + number)
        if changes:
            break
    assert changes[0] == BestChanged(of(paths, MESH), of(paths, LTE), "metered")


def test_path_that_becomes_metered_is_replaced() -> None:
    """The reason says so."""
    facts = SocketFacts()
    paths = PathSet(Redundancy.CRITICAL, c.PROBE_IDLE_S, Counter(), facts)
    paths.configure([LTE, MESH], 0.0)
    for path in (LTE, MESH):
        answer(paths, path, 1.0)
    facts.metered.add(LTE.socket)
    paths.set_metered()

    assert paths.update(2.0) == [BestChanged(of(paths, MESH), of(paths, LTE), "metered")]


def test_initiations_avoid_metered_paths_while_another_works() -> None:
    """The best one comes first; a path whose network is gone, or of an unproven address, is not among them."""
    paths = linked(MESH, LTE, SIK, metered={LTE.socket})
    paths.learn(PLACES[0], 1.0)
    paths.prefer(SIK, 1.0)
    assert paths.handshake_paths() == ([MESH, SIK], [])

    for path in (MESH, SIK):
        fail(paths, path, 5.0)
    assert paths.handshake_paths() == ([MESH, SIK], [LTE])
    paths.set_socket_state(MESH.socket, 6.0, is_up=False)
    assert paths.handshake_paths() == ([SIK], [LTE])


# Routes.


@pytest.mark.parametrize(
    ("redundancy", "critical", "stream"),
    [
        (Redundancy.CRITICAL, [LTE, MESH, SIK], [LTE]),
        (Redundancy.ALL, [LTE, MESH, SIK], [LTE, MESH]),
        (Redundancy.NONE, [LTE], [LTE]),
    ],
)
def test_routes_of_each_class(redundancy: Redundancy, critical: list[Path], stream: list[Path]) -> None:
    """The third path is metered: it gets critical frames, and no others."""
    paths = linked(LTE, MESH, SIK, redundancy=redundancy, metered={SIK.socket})

    assert route(paths, Class.CRITICAL) == critical
    assert route(paths, Class.STREAM) == stream
    assert route(paths, Class.BULK) == [LTE]
    assert paths.is_multiple


def test_stream_goes_along_every_path_while_the_best_is_suspect() -> None:
    """Also along a metered one: the question of the best is late, and it may be down."""
    paths = linked(LTE, MESH, SIK, metered={SIK.socket})
    suspect(paths, LTE, 3.0)

    assert route(paths, Class.STREAM) == [LTE, MESH, SIK]
    assert route(paths, Class.BULK) == [LTE]


def test_stream_avoids_metered_paths_while_the_best_loses_datagrams() -> None:
    """Loss may last for long, and metered bytes are paid for."""
    paths = linked(LTE, MESH, SIK, metered={SIK.socket})
    state = of(paths, LTE)
    state.condition, state.reason = PathCondition.SUSPECT, "loss"
    paths.update(3.0)

    assert route(paths, Class.STREAM) == [LTE, MESH]


def test_path_that_is_down_gets_critical_copies_for_ten_seconds_after_its_last_answer() -> None:
    """Paths that take turns to fail lose no critical frame."""
    paths = linked(LTE, MESH)
    fail(paths, MESH, 4.0)
    assert route(paths, Class.CRITICAL) == [LTE, MESH]
    assert paths.next_at <= 1.0 + c.COPIES_AFTER_ANSWER_S
    paths.update(1.0 + c.COPIES_AFTER_ANSWER_S)

    assert route(paths, Class.CRITICAL) == [LTE]
    assert not paths.is_multiple


def test_unproven_path_carries_nothing() -> None:
    """A question has to be answered first."""
    paths = path_set(LTE, MESH)
    answer(paths, LTE, 1.0)

    assert {cls: route(paths, cls) for cls in Class} == {cls: [LTE] for cls in Class}
    assert paths.has_several
    assert not paths.is_multiple


def test_without_a_path_there_is_no_route() -> None:
    """A responder that was not reached yet."""
    paths = path_set()
    paths.update(1.0)

    assert paths.best is None
    assert not paths.has_any
    assert all(not route(paths, cls) for cls in Class)


# Times between questions.


def busy(paths: PathSet, now: float) -> PathSet:
    """Frames are sent, also along the best path alone."""
    paths.active_at = paths.stream_at = now
    return paths


def test_path_of_the_stream_is_asked_often_and_a_standby_rarely() -> None:
    """If another one is usable; without stream the best path is a standby too."""
    paths = busy(linked(LTE, MESH), 2.0)
    assert paths.interval_s(of(paths, LTE), 2.0) == c.PROBE_FAST_S
    assert paths.interval_s(of(paths, MESH), 2.0) == c.PROBE_STANDBY_S
    assert paths.interval_s(of(paths, LTE), 2.0 + c.STREAM_ENDS_AFTER_S) == c.PROBE_STANDBY_S


def test_stream_begins_with_more_than_four_envelopes_a_second() -> None:
    """The frames of a ground station are rarer: its path is asked as rarely as a standby."""
    paths = linked(LTE, MESH)
    assert not any(paths.note_stream(20.0 + number / 4) for number in range(12))

    assert [paths.note_stream(30.0 + number / 5) for number in range(6)] == [False] * 4 + [True, False]
    assert paths.stream_at == 31.0


def test_only_usable_path_is_asked_every_five_seconds() -> None:
    """There is nothing to change to."""
    paths = busy(linked(LTE, MESH), 2.0)
    fail(paths, MESH, 2.0)

    assert paths.interval_s(of(paths, LTE), 2.0) == c.PROBE_INTERVAL_S


def test_only_path_is_asked_by_echo_requests() -> None:
    """No probe is sent."""
    paths = busy(linked(LTE), 2.0)

    assert paths.interval_s(of(paths, LTE), 2.0) == NEVER
    assert of(paths, LTE).question_at == NEVER


def test_suspect_and_recovering_paths_are_asked_often() -> None:
    """To know soon what they are."""
    paths = busy(linked(LTE, MESH), 20.0)
    suspect(paths, MESH, 20.0)
    assert paths.interval_s(of(paths, MESH), 20.0) == c.PROBE_FAST_S

    fail(paths, MESH, 21.0)
    answer(paths, MESH, 24.0)
    assert of(paths, MESH).is_recovering
    assert paths.interval_s(of(paths, MESH), 24.0) == c.PROBE_FAST_S


def test_path_that_is_down_is_asked_ever_less() -> None:
    """Often at first, then every second, after a minute every five."""
    paths = busy(linked(LTE, MESH), 20.0)
    fail(paths, MESH, 20.0)
    for age_s, expected in ((0.0, c.PROBE_FAST_S), (c.DOWN_AFTER_S, c.PROBE_DOWN_S), (60.0, c.PROBE_LONG_DOWN_S)):
        assert paths.interval_s(of(paths, MESH), 20.0 + age_s) == expected


def test_new_path_is_asked_often_until_its_round_trip_is_known_well() -> None:
    """After a few answers it is a standby."""
    paths = busy(linked(LTE, MESH), 2.0)
    of(paths, MESH).answers = c.SETTLING_ANSWERS - 1
    assert paths.interval_s(of(paths, MESH), 2.0) == c.PROBE_FAST_S
    answer(paths, MESH, 2.1)
    assert paths.interval_s(of(paths, MESH), 2.1) == c.PROBE_STANDBY_S


def test_path_of_a_new_session_is_asked_often_until_it_answers() -> None:
    """It carries traffic meanwhile, for ten seconds at most."""
    paths = path_set()
    state = paths.prefer(LTE, 0.0)

    assert paths.interval_s(state, 9.0) == c.PROBE_FAST_S


@pytest.mark.parametrize(("idle_probe_s", "expected"), [(15.0, 15.0), (40.0, 40.0), (0.0, NEVER)])
def test_idle_and_metered_paths_are_asked_as_configured(idle_probe_s: float, expected: float) -> None:
    """Zero: only when needed. A metered path that is the best, or whose others failed, is needed."""
    paths = linked(MESH, LTE, idle_probe_s=idle_probe_s, metered={LTE.socket})
    assert paths.interval_s(of(paths, LTE), 2.0) == expected
    assert paths.interval_s(of(paths, MESH), 2.0 + c.IDLE_AFTER_S) == expected

    busy(paths, 20.0)
    fail(paths, MESH, 20.0)
    assert paths.interval_s(of(paths, LTE), 20.0) < expected


def test_next_question_is_counted_from_the_last() -> None:
    """The deadline of the set is the earliest of all."""
    paths = busy(linked(LTE, MESH), 2.0)
    of(paths, LTE).questioned_at, of(paths, MESH).questioned_at = 1.9, 1.0
    paths.schedule(2.0)

    assert of(paths, LTE).question_at == pytest.approx(1.9 + c.PROBE_FAST_S)
    assert of(paths, MESH).question_at == 1.0 + c.PROBE_STANDBY_S
    assert paths.next_at <= of(paths, LTE).question_at


# Networks.


def test_path_of_an_absent_network_is_not_asked() -> None:
    """Until it is back: then at once."""
    paths = busy(linked(LTE, MESH), 2.0)
    paths.set_socket_state(MESH.socket, 2.0, is_up=False)
    paths.update(2.0)
    assert of(paths, MESH).question_at == NEVER
    assert paths.handshake_paths() == ([LTE], [])
    assert route(paths, Class.CRITICAL) == [LTE]

    paths.set_socket_state(MESH.socket, 9.0, is_up=True)
    paths.update(9.0)
    assert of(paths, MESH).question_at == 9.0


def test_changes_of_one_path_alone_are_not_reported() -> None:
    """The events of the peer say the same; with a second path they are."""
    paths = path_set(LTE)
    paths.prefer(LTE, 0.0)
    assert answer(paths, LTE, 1.0) == []
    assert fail(paths, LTE, 5.0) == []

    answer(paths, LTE, 6.0)
    paths.learn(MESH, 6.0)
    assert paths.update(6.0) == [ConditionChanged(of(paths, LTE), True, "answered")]
