"""Paths through relays beside direct ones: which is the best, which carry copies, and how long envelopes are."""

from __future__ import annotations

import pytest

from tests.core.harness import Pair, datagrams
from tests.core.harness import of as outputs_of
from tests.core.test_path_set import answer, fail, linked, of, path_set, route, suspect
from uavlinkd.core import constants as c
from uavlinkd.core import probing, wire
from uavlinkd.core.limits import prefix_of
from uavlinkd.core.outputs import Output, PathSuspected, Transmit
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.paths import BestChanged
from uavlinkd.core.settings import Class, Link

LTE, MESH = Path(0, ("192.0.2.1", 5790)), Path(1, ("198.51.100.1", 5790))
LTE_A, LTE_A2, LTE_B, LTE_C = (relayed(0, name, number) for number, name in enumerate(("a", "a", "b", "c"), 1))
MESH_A = relayed(1, "a", 9)


# The best path.


@pytest.mark.parametrize(("direct_s", "becomes_best"), [(0.05, True), (0.1, True), (0.115, True), (0.3, False)])
def test_direct_path_replaces_relayed_one_immediately(direct_s: float, becomes_best: bool) -> None:
    """Unless it is so much slower that the relayed one would replace it."""
    paths = linked(LTE_A)
    answer(paths, LTE_A, 1.1, 0.1)
    of(paths, LTE_A).srtt_s = 0.1
    paths.configure([LTE_A, LTE], 1.5)
    changes = answer(paths, LTE, 2.0, direct_s)
    assert (paths.best is of(paths, LTE)) is becomes_best
    reasons = [change.reason for change in changes if isinstance(change, BestChanged)]
    assert reasons == ["direct"] * becomes_best


def test_direct_path_stays_the_best_for_a_similar_relayed_one() -> None:
    """A relay is one more machine that may fail."""
    paths = linked(LTE, LTE_A)
    for tenth in range(11, 60):
        for path in (LTE, LTE_A):
            answer(paths, path, tenth / 10, 0.1)
    assert paths.best is of(paths, LTE)


def test_relayed_path_takes_over_from_a_direct_one_that_fails() -> None:
    """Without waiting."""
    paths = linked(LTE, LTE_A)
    fail(paths, LTE, 4.0)
    assert paths.best is of(paths, LTE_A)


# Copies.


def test_copies_go_along_two_paths_of_a_socket() -> None:
    """A direct one and the fastest relayed one."""
    paths = linked(LTE, LTE_A, LTE_B)
    assert route(paths, Class.CRITICAL) == [LTE, LTE_A]
    assert paths.is_multiple


@pytest.mark.parametrize("second", [LTE_A2, LTE_B], ids=["handle", "relay"])
def test_copies_go_through_two_relays_and_to_two_networks(second: Path) -> None:
    """A relay that dies must not take all copies with it, nor a network of the peer; a fourth would only cost."""
    paths = linked(LTE_A, second, LTE_B if second is LTE_A2 else LTE_A2, LTE_C)
    assert set(route(paths, Class.CRITICAL)) == {LTE_A, LTE_A2, LTE_B}


def test_copies_go_to_two_networks_beside_a_direct_path() -> None:
    """The direct path and one handle may lead to the same network of the peer."""
    paths = linked(LTE, LTE_A, LTE_B, LTE_A2)
    assert route(paths, Class.CRITICAL) == [LTE, LTE_A, LTE_A2]


def test_one_copy_goes_along_a_relay_beside_many_direct_paths() -> None:
    """If they fail together, it is there."""
    direct = [LTE, *(Path(0, (f"192.0.2.{number}", 5790)) for number in (2, 3, 4))]
    paths = linked(*direct, LTE_A, LTE_A2)
    assert route(paths, Class.CRITICAL) == [*direct, LTE_A]


def test_each_socket_has_its_own_copies() -> None:
    """LTE and mesh behind NAT, one relay: along both."""
    paths = linked(LTE_A, LTE_A2, MESH_A)
    assert route(paths, Class.CRITICAL) == [LTE_A, LTE_A2, MESH_A]


def test_further_relayed_path_replaces_a_direct_one_that_is_suspect() -> None:
    """At once: the direct one no longer counts as the network's own."""
    paths = linked(LTE, LTE_A, LTE_B)
    suspect(paths, LTE, 2.0)
    assert set(route(paths, Class.CRITICAL)) == {LTE, LTE_A, LTE_B}


def test_relayed_path_that_is_down_gives_its_place_to_another() -> None:
    """The one that works comes first, however slow."""
    paths = linked(LTE, LTE_A, LTE_B)
    fail(paths, LTE_A, 4.0)
    assert route(paths, Class.CRITICAL)[:2] == [LTE, LTE_B]


# Envelopes.


@pytest.mark.parametrize("cls", [Class.STREAM, Class.BULK])
def test_envelopes_along_a_relay_are_shorter(cls: Class) -> None:
    """With what the relay adds they are as long as direct ones."""
    assert linked(LTE_A).longest(cls) == c.DEFAULT_ENVELOPE_LIMIT - c.RELAY_BYTES
    assert linked(LTE).longest(cls) > c.DEFAULT_ENVELOPE_LIMIT


def test_copy_that_is_too_long_does_not_go_along_a_relay() -> None:
    """The longest direct envelope."""
    paths = linked(LTE, LTE_A)
    assert paths.carries(of(paths, LTE_A), c.RELAYED_ENVELOPE_LIMIT)
    assert not paths.carries(of(paths, LTE_A), c.RELAYED_ENVELOPE_LIMIT + 1)


def test_peer_without_relays_pays_nothing() -> None:
    """Its envelopes are not limited."""
    assert not linked(LTE, MESH).has_relayed
    assert not path_set().has_relayed


# Tries, and budgets.


def test_new_handles_do_not_hasten_initiations_without_limit() -> None:
    """A hostile relay changes them all the time. A peer that is not up is tried as often as at first, no more."""
    pair = Pair()
    pair.initiation(0.0)
    sent = 0
    for number in range(1, 1001):
        now = number / 1000
        pair.a.node.set_paths(pair.a.peer, [relayed(0, "a", number)], now)
        sent += len(datagrams(pair.a.timeout(now), wire.INITIATION))
    assert 1 <= sent <= 1 / c.RETRY_MIN_S + 1


def test_handles_of_one_relay_are_one_sender() -> None:
    """Each address of a peer has budgets of its own. A relay could invent as many handles."""
    assert LTE_A.sender == LTE_A2.sender == "relay a"
    assert LTE.sender == LTE.place
    assert LTE_A.sender != LTE_B.sender
    assert prefix_of(LTE_A.host) != prefix_of(LTE_B.host)


# A relay that fails.


@pytest.fixture
def pair() -> Pair:
    """Linked along a relay."""
    link = Link(features=c.FEATURE_RECORDS)
    made = Pair(link, link)
    made.a.peer_at, made.b.peer_at = LTE_A, LTE_A2
    for side in (made.a, made.b):
        side.configure_path(0.0)
    made.establish()
    assert made.carries(0.0)
    return made


def suspected(outputs: list[Output]) -> list[Path]:
    """The paths that are reported to the shell."""
    return [event.path for event in outputs_of(outputs, PathSuspected)]


def test_relayed_path_that_becomes_suspect_is_reported(pair: Pair) -> None:
    """The shell asks the relay then."""
    state = pair.a.peer.paths.find(LTE_A)
    assert state is not None
    state.make_probe(3, 0, 1.0)
    assert suspected(probing.update(pair.a.peer, 3.0)) == [LTE_A]
    assert suspected(probing.update(pair.a.peer, 3.1)) == []


def test_question_about_a_silence_reports_the_path(pair: Pair) -> None:
    """The only path of a peer gets no probes."""
    pair.a.send(1.0)
    assert LTE_A in suspected(pair.a.timeout(1.0 + pair.a.peer.echo_after_s))


def test_path_ends_with_its_handle(pair: Pair) -> None:
    """Also the best one: it leads nowhere any more. A direct one stays."""
    pair.a.node.set_paths(pair.a.peer, [LTE_B], 1.0)
    assert pair.a.peer.paths.find(LTE_A) is None
    assert pair.a.peer.path != LTE_A
    paths = linked(LTE)
    paths.configure([LTE_B], 2.0)
    assert paths.find(LTE) is not None


def test_one_path_is_asked(pair: Pair) -> None:
    """By an echo request, and by a probe if there are several; not along an unknown path, nor one without network."""
    node, peer = pair.a.node, pair.a.peer
    assert [sent.path for sent in outputs_of(node.ask(peer, LTE_A, 1.0), Transmit)] == [LTE_A]
    assert node.ask(peer, LTE_B, 1.0) == []
    node.set_paths(peer, [LTE_A, LTE_B], 1.0)
    assert [sent.path for sent in outputs_of(node.ask(peer, LTE_B, 1.1), Transmit)] == [LTE_B, LTE_B]
    node.set_socket_state(0, 1.2, is_up=False)
    assert node.ask(peer, LTE_B, 1.3) == []


def test_peer_without_a_session_is_not_asked() -> None:
    """There is no key for the question."""
    pair = Pair()
    assert pair.a.node.ask(pair.a.peer, pair.a.peer_at, 0.0) == []
