"""The paths to a peer: slots, the best one, the route of each class, and how often each path is asked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set as AbstractSet

import pytest

from tests.protocol.harness import Named
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.outputs import PathChanged, PathEvent, PathStateChanged
from uavlinkd.protocol.path import SERIAL_HOST, Path, SocketAddress, SocketFacts, relayed
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.settings import Class, Redundancy

LTE, MESH, SIK = (Path(number, (f"192.0.2.{number + 1}", 5790)) for number in range(3))
WEB = Path(3, ("wss://relay.example.org:443/uavlink", 0))
PEER = Named("bravo")
PLACES = [Path(0, (f"203.0.113.{number}", 4000)) for number in range(1, 9)]


def path_set(
    *paths: Path,
    redundancy: Redundancy = Redundancy.CRITICAL,
    idle_probe_s: float = c.PROBE_IDLE_S,
    metered: AbstractSet[int] = frozenset(),
    streams: AbstractSet[int] = frozenset(),
    known: Counter[SocketAddress] | None = None,
) -> PathSet:
    """A set with these configured paths."""
    facts = SocketFacts(metered)
    for number in streams:
        facts.add_stream(number)
    made = PathSet(redundancy, idle_probe_s, Counter() if known is None else known, facts)
    made.configure(paths, 0.0)
    return made


def of(paths: PathSet, path: Path) -> PathState:
    """The slot of a path."""
    return paths.by_path[path]


def answer(paths: PathSet, path: Path, now: float, round_trip_s: float = 0.1) -> list[PathEvent]:
    """A question along a path is answered."""
    state = of(paths, path)
    question = round(now * 1000) + 1
    state.make_probe(question, 0, now - round_trip_s)
    assert state.receive_answer(question, state.sent, now) is not None
    paths.note_answer(state, now)
    return paths.update(PEER, now)


def fail(paths: PathSet, path: Path, now: float) -> list[PathEvent]:
    """Two questions along a path get no answer, until then."""
    for question, before_s in ((1, 2.0), (2, 1.5)):
        of(paths, path).make_probe(question, 0, now - before_s)
    return paths.update(PEER, now)


def suspect(paths: PathSet, path: Path, now: float) -> list[PathEvent]:
    """One question along a path gets no answer, until then."""
    of(paths, path).make_probe(3, 0, now - 0.9)
    changes = paths.update(PEER, now)
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


def test_slots_of_configured_paths() -> None:
    """Eight, two of them to one host along one socket; a path that is configured twice is one path."""
    many = [Path(number, ("192.0.2.1", 5790)) for number in range(12)]
    assert path_set(*many).configured == tuple(many[: c.CONFIGURED_PATHS])
    same, other = [Path(0, ("192.0.2.1", port)) for port in (1, 2, 3)], Path(1, ("192.0.2.1", 3))
    assert path_set(*same, other).configured == (*same[: c.PATHS_PER_HOST], other)
    assert path_set(LTE, MESH, LTE).configured == (LTE, MESH)


def test_path_that_works_outlives_its_configuration() -> None:
    """As a learned path. One that is configured later keeps its state, and an unproven one goes."""
    paths = linked(LTE, MESH)
    paths.configure([SIK], 2.0)
    assert [state.path for state in paths.states] == [SIK, LTE, MESH]
    assert paths.configured == (SIK,)
    paths.configure([MESH], 3.0)
    assert [state.path for state in paths.states] == [MESH, LTE]
    assert paths.configured == (MESH,)
    assert of(paths, MESH).is_validated
    assert paths.has_several
    paths.configure([], 3.0)
    fail(paths, MESH, 5.0)
    assert paths.find(MESH) is not None
    paths.update(PEER, 5.0 + c.FORMER_PATH_S)
    assert paths.find(MESH) is None
    assert not paths.has_several


@pytest.mark.parametrize("kept", ["validated", "working", "answering", "recent"])
def test_least_useful_learned_path_makes_room(kept: str) -> None:
    """First one that was never validated, then one that neither works nor answers again, then the one that answered
    longest ago, then the one that was first for longest.
    """
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
    if kept == "answering":
        fail(paths, PLACES[0], 2.9)
        answer(paths, PLACES[0], 2.95)
        assert of(paths, PLACES[0]).is_recovering
    paths.learn(PLACES[6], 3.0)
    gone = {"validated": PLACES[2], "working": PLACES[3], "answering": PLACES[1], "recent": PLACES[0]}[kept]
    assert paths.find(gone) is None
    assert len(paths.states) == 1 + c.LEARNED_PATHS
    assert len({state.number for state in paths.states}) == len(paths.states)
    assert all(paths.with_number(state.number) is state for state in paths.states)


def test_addresses_where_peers_were_are_known() -> None:
    """From the session or the first answer on, until the last of them has freed its slot."""
    known = Counter[SocketAddress]()
    paths, other = path_set(LTE, known=known), path_set(LTE, known=known)
    assert not known
    paths.prefer(MESH, 0.0)
    for peer in (paths, other):
        answer(peer, LTE, 1.0)
    assert known == {LTE.address: 2, MESH.address: 1}
    paths.clear()
    assert known == {LTE.address: 1}
    other.clear()
    assert not known


# The best path.


def test_session_or_first_answer_makes_the_best_path() -> None:
    """New keys do not change the election while the best path works."""
    paths = path_set(LTE, MESH)
    assert answer(paths, MESH, 1.0) == [PathStateChanged(PEER, MESH, True, "answered")]
    assert paths.best is of(paths, MESH)
    paths = linked(LTE, MESH)
    paths.prefer(MESH, 2.0)
    assert paths.best is of(paths, LTE)
    for path in (LTE, MESH):
        of(paths, path).set_off(is_off=True, now=3.0)
    of(paths, MESH).set_off(is_off=False, now=3.0)
    paths.prefer(MESH, 4.0)
    assert paths.update(PEER, 4.0)[0] == PathChanged(PEER, MESH, LTE, "session")


def test_session_along_a_slot_from_before_a_silence_is_not_given_up() -> None:
    """No timer looked at the slot while the peer was away. The path has its whole time for an answer again."""
    paths = path_set()
    paths.learn(PLACES[0], 1.0)
    now = 1.0 + 2 * c.FIRST_PATH_S
    best = paths.prefer(PLACES[0], now)
    paths.update(PEER, now + c.FIRST_PATH_S - 0.1)
    assert paths.best is best
    paths.update(PEER, now + c.FIRST_PATH_S)
    assert paths.best is None


def test_failed_path_is_replaced_at_once_by_the_cheapest_that_works() -> None:
    """By a usable one before a suspect one. It stays the best while there is no other: it may come back first."""
    paths = linked(LTE, SIK, MESH)
    of(paths, SIK).srtt_s = 1.0
    assert fail(paths, LTE, 4.0) == [
        PathChanged(PEER, MESH, LTE, "unanswered"),
        PathStateChanged(PEER, LTE, False, "unanswered"),
    ]
    paths = linked(LTE, MESH, SIK)
    suspect(paths, MESH, 4.0)
    fail(paths, LTE, 4.0)
    assert paths.best is of(paths, SIK)
    fail(paths, MESH, 6.0)
    fail(paths, SIK, 8.0)
    assert paths.best is of(paths, SIK)
    assert not paths.works
    assert route(paths, Class.STREAM) == [SIK]


def test_recovering_path_is_used_at_once_when_the_last_other_fails() -> None:
    """It need not prove itself for two seconds then."""
    paths = linked(LTE, MESH)
    fail(paths, MESH, 4.0)
    answer(paths, MESH, 5.0)
    assert of(paths, MESH).is_recovering
    assert PathChanged(PEER, MESH, LTE, "unanswered") in fail(paths, LTE, 5.5)
    assert of(paths, MESH).condition is PathCondition.USABLE


def test_better_path_is_elected_after_two_seconds() -> None:
    """Not before; one that was better for a moment begins again. A suspect path is not elected."""
    paths = linked(LTE, MESH)
    for srtt_s, now in ((0.4, 2.0), (0.1, 3.0), (0.4, 3.5), (0.4, 3.5 + c.BETTER_FOR_S - 0.001)):
        of(paths, LTE).srtt_s = srtt_s
        assert paths.update(PEER, now) == []
    assert paths.due_at <= 3.5 + c.BETTER_FOR_S
    assert paths.update(PEER, 3.5 + c.BETTER_FOR_S) == [PathChanged(PEER, MESH, LTE, "faster")]
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s = 2.0
    paths.update(PEER, 2.0)
    suspect(paths, MESH, 3.0)
    assert paths.update(PEER, 2.0 + c.BETTER_FOR_S) == []


@pytest.mark.parametrize(
    ("best_s", "other_s", "is_better"),
    [(0.400, 0.322, False), (0.400, 0.318, True), (0.060, 0.042, False), (0.060, 0.038, True)],
)
def test_better_is_by_a_fifth_and_by_ten_milliseconds(best_s: float, other_s: float, is_better: bool) -> None:
    """Of the one-way delay, half of the round trip: two paths of nearly equal delay do not take turns."""
    paths = linked(LTE, MESH)
    of(paths, LTE).srtt_s, of(paths, MESH).srtt_s = best_s, other_s
    paths.update(PEER, 2.0)
    assert bool(paths.update(PEER, 2.0 + c.BETTER_FOR_S)) == is_better


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
    paths.update(PEER, 2.6)
    assert paths.update(PEER, 2.6 + c.BETTER_FOR_S) == [PathChanged(PEER, MESH, LTE, "loss")]


# Metered paths.


def test_metered_path_is_the_best_only_without_another() -> None:
    """However fast it is; when another one works again it is replaced at once."""
    paths = linked(MESH, LTE, metered={LTE.socket})
    of(paths, MESH).srtt_s = 3.0
    paths.update(PEER, 2.0)
    assert paths.update(PEER, 10.0) == []
    assert paths.role(of(paths, LTE)) == "metered"
    of(paths, MESH).srtt_s = 0.1
    assert fail(paths, MESH, 60.0)[0] == PathChanged(PEER, LTE, MESH, "unanswered")
    assert [paths.role(of(paths, path)) for path in (LTE, MESH)] == ["best", "standby"]
    for number in range(4):
        assert paths.best is of(paths, LTE)
        if changes := answer(paths, MESH, 61.0 + number):
            break
    assert changes[0] == PathChanged(PEER, MESH, LTE, "metered")
    paths.facts.metered = {MESH.socket}
    paths.set_metered()
    assert paths.update(PEER, 65.0) == [PathChanged(PEER, LTE, MESH, "metered")]


def test_path_by_tls_is_the_best_only_without_another() -> None:
    """Also without a metered one, which replaces it at once when it works again."""
    paths = path_set(WEB, LTE, metered={LTE.socket}, streams={WEB.socket})
    answer(paths, WEB, 1.0, 0.01)
    assert paths.best is of(paths, WEB)
    assert paths.role(of(paths, LTE)) == "metered"
    assert answer(paths, LTE, 2.0, 0.5)[0] == PathChanged(PEER, LTE, WEB, "udp")
    paths.set_socket_state(WEB.socket, 3.0, is_up=False)
    assert PathStateChanged(PEER, WEB, False, "closed") in paths.update(PEER, 3.0), "its network is still there"
    assert (LTE.is_udp, LTE.is_web) == (True, False)
    assert (WEB.is_udp, WEB.is_web) == (False, True)
    assert not relayed(WEB.socket, "vps", 7).is_udp
    assert not Path(0, (SERIAL_HOST, 0)).is_udp


def test_initiations_avoid_metered_paths_while_another_works() -> None:
    """The best one comes first; a path whose network is gone, or of an unproven address, is not among them."""
    paths = linked(MESH, LTE, SIK, metered={LTE.socket})
    paths.learn(PLACES[0], 1.0)
    paths.prefer(SIK, 1.0)
    assert paths.handshake_paths() == [MESH, SIK]
    assert paths.handshake_paths(is_answering=False) == [MESH, SIK, LTE]
    for path in (MESH, SIK):
        fail(paths, path, 5.0)
    assert paths.handshake_paths() == [LTE, MESH, SIK]
    paths.set_socket_state(MESH.socket, 6.0, is_up=False)
    assert paths.handshake_paths() == [LTE, SIK]


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
    """The third path is metered: it gets critical frames, and no others. So does one that is down."""
    paths = linked(LTE, MESH, SIK, redundancy=redundancy, metered={SIK.socket})
    assert [route(paths, cls) for cls in Class] == [critical, stream, [LTE]]
    assert paths.is_multiple
    for path in (MESH, SIK):
        fail(paths, path, 4.0)
    paths.update(PEER, 600.0)
    assert [route(paths, cls) for cls in Class] == [critical, [LTE], [LTE]]
    assert paths.is_multiple


@pytest.mark.parametrize("reason", ["unanswered", "loss"])
def test_stream_goes_along_every_path_while_the_best_is_suspect(reason: str) -> None:
    """Also along a metered one if an answer is late: the best may be down. Loss may last, and metered bytes cost."""
    paths = linked(LTE, MESH, SIK, metered={SIK.socket})
    suspect(paths, LTE, 3.0)
    of(paths, LTE).reason = reason
    paths.update(PEER, 3.0)
    assert route(paths, Class.STREAM) == ([LTE, MESH, SIK] if reason == "unanswered" else [LTE, MESH])
    assert route(paths, Class.BULK) == [LTE]


# Times between questions.


def busy(paths: PathSet, now: float) -> PathSet:
    """Frames are sent, also along the best path alone."""
    paths.active_at = paths.stream_at = now
    return paths


def test_path_of_the_stream_is_asked_often_and_a_standby_rarely() -> None:
    """A new one is asked often. Without stream the best path is a standby too; if it alone works, it is rarer."""
    paths = busy(linked(LTE, MESH), 2.0)
    of(paths, MESH).answers = c.SETTLING_ANSWERS - 1
    assert [paths.interval_s(of(paths, path), 2.0) for path in (LTE, MESH)] == [c.PROBE_FAST_S] * 2
    answer(paths, MESH, 2.1)
    assert paths.interval_s(of(paths, MESH), 2.1) == c.PROBE_STANDBY_S
    assert paths.interval_s(of(paths, LTE), 2.0 + c.STREAM_ENDS_AFTER_S) == c.PROBE_STANDBY_S
    fail(paths, MESH, 2.5)
    assert paths.interval_s(of(paths, LTE), 2.5) == c.PROBE_INTERVAL_S


def test_stream_begins_with_more_than_four_envelopes_a_second() -> None:
    """The frames of a ground station are rarer: its path is asked as rarely as a standby."""
    paths = linked(LTE, MESH)
    assert not any(paths.note_stream(20.0 + number / 4) for number in range(12))
    assert [paths.note_stream(30.0 + number / 5) for number in range(6)] == [False] * 4 + [True, False]
    assert paths.stream_at == 31.0


def test_path_that_is_down_is_asked_ever_less() -> None:
    """As often as a suspect or a recovering one at first, then every second, after a minute every five."""
    paths = busy(linked(LTE, MESH), 20.0)
    suspect(paths, MESH, 20.0)
    assert paths.interval_s(of(paths, MESH), 20.0) == c.PROBE_FAST_S
    fail(paths, MESH, 21.0)
    for age_s, expected in ((0.0, c.PROBE_FAST_S), (c.DOWN_AFTER_S, c.PROBE_DOWN_S), (60.0, c.PROBE_LONG_DOWN_S)):
        assert paths.interval_s(of(paths, MESH), 21.0 + age_s) == expected
    answer(paths, MESH, 24.0)
    assert of(paths, MESH).is_recovering
    assert paths.interval_s(of(paths, MESH), 24.0) == c.PROBE_FAST_S


@pytest.mark.parametrize(("idle_probe_s", "expected"), [(15.0, 15.0), (40.0, 40.0), (0.0, NEVER)])
def test_idle_and_metered_paths_are_asked_as_configured(idle_probe_s: float, expected: float) -> None:
    """Zero: only when needed. A metered path that is the best, or whose others failed, is needed."""
    paths = linked(MESH, LTE, idle_probe_s=idle_probe_s, metered={LTE.socket})
    assert paths.interval_s(of(paths, LTE), 2.0) == expected
    assert paths.interval_s(of(paths, MESH), 2.0 + c.IDLE_AFTER_S) == expected
    busy(paths, 20.0)
    fail(paths, MESH, 20.0)
    assert paths.interval_s(of(paths, LTE), 20.0) < expected


# Networks.


def test_path_of_an_absent_network_is_not_used_until_it_is_back() -> None:
    """It is replaced without waiting for questions, and asked at once when it is back."""
    paths = busy(linked(LTE, MESH), 2.0)
    paths.set_socket_state(LTE.socket, 2.0, is_up=False)
    assert paths.update(PEER, 2.0)[0] == PathChanged(PEER, MESH, LTE, "network")
    assert of(paths, LTE).question_at == NEVER
    assert paths.handshake_paths() == [MESH]
    assert route(paths, Class.CRITICAL) == [MESH]
    paths.set_socket_state(LTE.socket, 9.0, is_up=True)
    paths.update(PEER, 9.0)
    assert of(paths, LTE).question_at == 9.0
