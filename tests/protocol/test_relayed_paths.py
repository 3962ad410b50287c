"""Paths through relays beside direct ones: which is the best, which carry copies, and how long envelopes are."""

from __future__ import annotations

import pytest

from tests.protocol.harness import AT_A, AT_B, KEY_A, KEY_C, Pair, datagrams, only, seeded
from tests.protocol.harness import of as outputs_of
from tests.protocol.test_path_set import PEER, answer, fail, linked, of, path_set, route, suspect
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, probing, wire
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.limits import prefix_of
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Dropped, Output, PathChanged, PathSuspected, PeerLost, Transmit
from uavlinkd.protocol.path import Path, relay_name, relayed
from uavlinkd.protocol.settings import Class, Link, PeerSettings
from uavlinkd.protocol.wire import Probe

LTE, MESH = Path(0, ("192.0.2.1", 5790)), Path(1, ("198.51.100.1", 5790))
DIRECT = [LTE, *(Path(0, (f"192.0.2.{number}", 5790)) for number in (2, 3, 4))]
LTE_A, LTE_A2, LTE_B, LTE_C = (relayed(0, name, number) for number, name in enumerate(("a", "a", "b", "c"), 1))
MESH_A = relayed(1, "a", 9)


def test_relayed_path_names_relay_and_handle() -> None:
    """Two handles of one relay are one host, two places, and one sender: a relay could invent as many."""
    assert LTE_A.is_relayed
    assert [relay_name(path.address) for path in (LTE_B, LTE)] == ["b", None]
    assert not LTE_A.is_serial
    assert not AT_A.is_relayed
    assert LTE_A.host == LTE_A2.host == LTE_A.sender == LTE_A2.sender == "relay a" != LTE_B.sender
    assert LTE_A.place != LTE_A2.place
    assert LTE.sender == LTE.place
    assert prefix_of(LTE_A.host) != prefix_of(LTE_B.host)


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
    assert [change.reason for change in changes if isinstance(change, PathChanged)] == ["direct"] * becomes_best


# Copies.


@pytest.mark.parametrize(
    ("paths", "carrying"),
    [
        pytest.param([LTE, LTE_A, LTE_B], [LTE, LTE_A], id="a direct one and the fastest relayed one"),
        pytest.param([LTE_A, LTE_A2, LTE_B, LTE_C], [LTE_A, LTE_A2, LTE_B], id="two handles first"),
        pytest.param([LTE_A, LTE_B, LTE_A2, LTE_C], [LTE_A, LTE_B, LTE_A2], id="two relays first"),
        pytest.param([LTE, LTE_A, LTE_B, LTE_A2], [LTE, LTE_A, LTE_A2], id="two networks of the peer"),
        pytest.param([*DIRECT, LTE_A, LTE_A2], [*DIRECT, LTE_A], id="one beside many direct ones"),
        pytest.param([LTE_A, LTE_A2, MESH_A], [LTE_A, LTE_A2, MESH_A], id="each socket has its own"),
    ],
)
def test_one_failure_leaves_a_path_with_copies(paths: list[Path], carrying: list[Path]) -> None:
    """Of a relay, or of a network at either end; further copies would only cost."""
    made = linked(*paths)
    assert route(made, Class.CRITICAL) == carrying
    assert made.is_multiple


def test_further_relayed_path_replaces_one_that_is_suspect_or_down() -> None:
    """At once. The one that works comes first, however slow."""
    paths = linked(LTE, LTE_A, LTE_B)
    suspect(paths, LTE, 2.0)
    assert set(route(paths, Class.CRITICAL)) == {LTE, LTE_A, LTE_B}
    paths = linked(LTE, LTE_A, LTE_B)
    fail(paths, LTE_A, 4.0)
    assert route(paths, Class.CRITICAL)[:2] == [LTE, LTE_B]


def test_new_handle_hastens_the_questions_along_all_paths() -> None:
    """The peer's NAT has forgotten it. Its former handle must not carry the copies for seconds, nor the direct path
    the stream. A relay that invents handles causes no more questions than suspect paths get.
    """
    paths = linked(LTE, LTE_A)
    asked_at = 4.0 - c.PROBE_FAST_S
    of(paths, LTE).questioned_at, of(paths, LTE_A).questioned_at = asked_at - 0.01, asked_at + 0.01
    paths.configure([LTE, LTE_A], 4.0)
    paths.schedule(4.0)
    assert of(paths, LTE).question_at > 4.0  # nothing is new
    paths.configure([LTE, LTE_A, LTE_A2], 4.0)
    paths.schedule(4.0)
    assert of(paths, LTE).question_at == 4.0 < of(paths, LTE_A).question_at
    answer(paths, LTE_A2, 4.1, 0.2)
    suspect(paths, LTE_A, 4.2)
    assert route(paths, Class.CRITICAL) == [LTE, LTE_A2, LTE_A]


def test_new_handles_cost_little_along_a_metered_standby_path() -> None:
    """A hostile relay invents handles all the time. The best path is asked as any other, also if it is metered."""
    paths = linked(LTE, LTE_A)
    assert paths.best is of(paths, LTE)
    for state in paths.states:
        state.is_metered, state.questioned_at = True, 1.0
    for handle, now, asked_at in ((LTE_A2, 5.9, 1.0), (LTE_B, 6.0, -c.NEVER)):
        paths.configure([LTE, LTE_A, handle], now)
        assert [of(paths, path).questioned_at for path in (LTE, LTE_A)] == [-c.NEVER, asked_at]


# Envelopes.


def test_envelopes_along_a_relay_are_shorter() -> None:
    """With what the relay adds they are as long as direct ones. The longest direct one gets no copy there."""
    for path, longest in ((LTE_A, c.DEFAULT_ENVELOPE_LIMIT - c.RELAY_BYTES), (LTE, c.MAX_ENVELOPE_LIMIT)):
        paths = linked(path)
        of(paths, path).envelope_limit.acknowledge(c.MAX_ENVELOPE_LIMIT, 1.0)
        paths.update(PEER, 1.0)
        assert [paths.longest[cls] for cls in (Class.STREAM, Class.BULK)] == [longest] * 2
    paths = linked(LTE, LTE_A)
    of(paths, LTE_A).envelope_limit.acknowledge(c.MAX_ENVELOPE_LIMIT, 1.0)
    sizes = c.RELAYED_ENVELOPE_LIMIT, c.RELAYED_ENVELOPE_LIMIT + 1
    assert [paths.carries(of(paths, LTE_A), size) for size in sizes] == [True, False]
    assert [made.has_relayed for made in (linked(LTE, MESH), path_set(), paths)] == [False, False, True]


def test_classes_matter_before_a_new_relayed_path_has_answered() -> None:
    """It carries the critical ones again then. Meanwhile the other path may be dead."""
    paths = linked(LTE)
    paths.configure([LTE, LTE_A], 2.0)
    paths.update(PEER, 2.0)
    assert paths.is_multiple
    assert route(paths, Class.CRITICAL) == [LTE]
    paths.configure([LTE], 2.1)
    paths.update(PEER, 2.1)
    assert (paths.is_multiple, paths.has_relayed) == (False, True)


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
    """The shell asks the relay, again until the path answers or is down: a NAT may forget the relay after its first
    answer. An only path gets no probes: a question about a silence reports it.
    """
    pair.a.peer.paths.by_path[LTE_A].make_probe(3, 0, 1.0)
    assert [suspected(probing.update(pair.a.peer, now)) for now in (3.0, 3.1)] == [[LTE_A], [LTE_A]]
    pair.a.send(4.0)
    assert LTE_A in suspected(pair.a.timeout(4.0 + pair.a.peer.echo_after_s))


def test_relays_are_asked_when_a_direct_path_from_their_socket_fails(pair: Pair) -> None:
    """The NAT has perhaps forgotten both, and relayed paths are probed rarely."""
    paths = pair.a.peer.paths
    paths.configure([LTE, LTE_A, MESH_A], 1.0)
    for path in (LTE, LTE_A, MESH_A):
        answer(paths, path, 1.0)
    paths.by_path[LTE].make_probe(3, 0, 1.0)
    assert [suspected(probing.update(pair.a.peer, now)) for now in (3.0, 3.1)] == [[LTE_A], []]


def resent(pair: Pair, path: Path, now: float) -> list[bytes]:
    """What a side sends again when a question along this path, beside the relayed one, is answered."""
    paths, session = pair.a.peer.paths, pair.a.session
    paths.configure([LTE_A, path], now)
    state, question, before = paths.by_path[path], round(10 * now), paths.by_path[path].sent
    state.make_probe(question, 0, now)
    out = probing.receive_probe(pair.a.peer, session, Probe(0, question, 0, 0), state, now)
    sent = [output.datagram for output in outputs_of(out, Transmit) if output.path == path]
    assert state.sent == before + len(sent), "the peer counts them too"
    return sent


def send_critical(pair: Pair, now: float, size: int = 20) -> bytes:
    """Send a critical envelope along the relayed path."""
    sent = pair.a.node.send(pair.a.peer, [b"\xfd" + bytes(size)], now, Class.CRITICAL)
    return outputs_of(sent, Transmit)[0].datagram


def test_new_relayed_path_carries_recent_critical_envelopes(pair: Pair) -> None:
    """Once: the path that they went along may have failed."""
    sent = [send_critical(pair, now) for now in (2.6, 4.0, 4.5)]
    pair.a.node.send(pair.a.peer, [b"\xfd" + bytes(20)], 4.6, Class.STREAM)
    assert resent(pair, LTE_A2, 4.7) == sent[1:]
    assert resent(pair, LTE_B, 4.8) == []


def test_no_other_envelope_is_sent_again_and_along_no_other_path(pair: Pair) -> None:
    """A direct path, or one that has answered before, is no replacement. A former session's envelopes are old."""
    assert resent(pair, LTE_B, 1.0) == []
    recent = send_critical(pair, 1.1)
    assert resent(pair, LTE, 1.2) == resent(pair, LTE_A, 1.3) == []
    assert resent(pair, LTE_A2, 1.4) == [recent]
    send_critical(pair, 1.5, c.MIN_ENVELOPE_LIMIT)
    pair.a.node.facts.envelope_limits = {MESH_A.socket: c.MIN_ENVELOPE_LIMIT}
    assert resent(pair, MESH_A, 1.6) == [], "too long for it"
    send_critical(pair, 1.7)
    pair.complete(datagrams(establish.initiate(pair.a.peer, 1.8), wire.INITIATION)[0], 1.8)
    assert resent(pair, LTE_B, 1.9) == []


def test_new_handle_takes_the_place_of_the_only_one(pair: Pair) -> None:
    """At once, and critical envelopes are sent again there: a member's connection by TLS was reset."""
    peer, node = pair.a.peer, pair.a.node
    assert peer.paths.is_multiple, "critical envelopes are remembered"
    sent = send_critical(pair, 3.0)
    node.set_paths(peer, [LTE_A2], 3.1)
    pair.a.timeout(3.1)
    assert peer.path == LTE_A2
    meanwhile = outputs_of(node.send(peer, [b"\xfd" + bytes(20)], 3.2, Class.CRITICAL), Transmit)
    assert [output.path for output in meanwhile] == [LTE_A2]
    state = peer.paths.by_path[LTE_A2]
    state.make_probe(7, 0, 3.2)
    answered = probing.receive_probe(peer, pair.a.session, Probe(0, 7, 0, 0), state, 3.3)
    assert [output.datagram for output in outputs_of(answered, Transmit)] == [sent, meanwhile[0].datagram]


def test_critical_frames_wait_for_a_handle(pair: Pair) -> None:
    """The relay ended the last one, because it noticed first that the peer's connection was reset."""
    peer, node = pair.a.peer, pair.a.node
    node.set_paths(peer, [], 3.0)
    pair.a.timeout(3.0)
    frame = b"\xfd" + bytes(20)
    assert node.send(peer, [frame], 3.1, Class.CRITICAL) == []
    too_long = node.send(peer, [b"\xfd" + bytes(c.MAX_ENVELOPE_LIMIT)], 3.1, Class.CRITICAL)
    assert [output.reason for output in outputs_of(too_long, Dropped)] == [DropReason.TOO_LARGE]
    dropped = node.send(peer, [frame], 3.1, Class.STREAM)
    assert [output.reason for output in outputs_of(dropped, Dropped)] == [DropReason.NO_SESSION]
    node.set_paths(peer, [LTE_A2], 3.2)
    state = peer.paths.by_path[LTE_A2]
    state.make_probe(7, 0, 3.2)
    out = probing.receive_probe(peer, pair.a.session, Probe(0, 7, 0, 0), state, 3.3)
    assert len(outputs_of(out, Transmit)) == 1


def test_new_handle_does_not_replace_a_path_that_works() -> None:
    paths = linked(LTE, LTE_A)
    paths.best = of(paths, LTE_A)
    paths.configure([LTE, LTE_A2], 2.0)
    paths.update(PEER, 2.0)
    assert paths.best is of(paths, LTE)


def test_path_ends_with_its_handle(pair: Pair) -> None:
    """Also the best one: it leads nowhere any more. A direct one stays."""
    pair.a.node.set_paths(pair.a.peer, [LTE_B], 1.0)
    assert pair.a.peer.paths.find(LTE_A) is None
    assert pair.a.peer.path != LTE_A
    paths = linked(LTE)
    paths.configure([LTE_B], 2.0)
    assert paths.find(LTE) is not None


def test_one_path_is_asked(pair: Pair) -> None:
    """By an echo request, and by a probe if there are several; not along an unknown path, nor without a session."""
    node, peer = pair.a.node, pair.a.peer
    assert [sent.path for sent in outputs_of(node.ask(peer, LTE_A, 1.0), Transmit)] == [LTE_A]
    assert node.ask(peer, LTE_B, 1.0) == []
    node.set_paths(peer, [LTE_A, LTE_B], 1.0)
    assert [sent.path for sent in outputs_of(node.ask(peer, LTE_B, 1.1), Transmit)] == [LTE_B, LTE_B]
    node.set_socket_state(0, 1.2, is_up=False)
    assert node.ask(peer, LTE_B, 1.3) == []
    other = Pair()
    assert other.a.node.ask(other.a.peer, other.a.peer_at, 0.0) == []


def test_peer_without_any_path_is_lost() -> None:
    """Nothing can be sent to it any more, so no answer is missed: its link ends after the usual time."""
    pair = Pair(Link(verify_interval_s=1e6), Link(verify_interval_s=1e6))
    pair.a.node.set_paths(pair.a.peer, [LTE_A], 0.0)
    pair.a.peer_at = LTE_A
    pair.establish()
    pair.a.node.set_paths(pair.a.peer, [], 1.0)
    assert not outputs_of(pair.a.timeout(3.9), PeerLost)
    assert outputs_of(pair.a.timeout(1.0 + c.LOST_AFTER_S), PeerLost)


def test_peers_behind_relays_are_closed_first() -> None:
    """The close to the relay ends the handles along which the others are reached."""
    pair = Pair().establish()
    behind = pair.a.node.add_peer(PeerSettings("behind", KEY_C.public), 1.0)
    pair.a.node.set_paths(behind, [LTE_A], 1.0)
    initiation = only(datagrams(pair.a.timeout(1.0), wire.INITIATION))
    other = Node(Secret(KEY_C._private.private_bytes_raw()), seeded(5), 1.0)
    other.add_peer(PeerSettings("alpha", KEY_A.public), 1.0)
    (response,) = datagrams(other.receive(initiation, LTE_A, 1.0))
    pair.a.receive(response, 1.0, LTE_A)
    assert [sent.path for sent in outputs_of(pair.a.node.close(2.0), Transmit)] == [LTE_A, AT_B]
