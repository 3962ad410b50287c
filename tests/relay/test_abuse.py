"""What captured members and strangers can make a relay and its members do: no more than the specification says."""

from __future__ import annotations

import tracemalloc

import pytest

from tests.fuzz.relays import HOMES, KEYS, RELAY_AT, STRANGERS, FuzzedRelay
from tests.protocol.harness import Pair, of
from tests.relay.test_direct_search import HOME_A, LINK, leads_to_mesh
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import PathStateChanged, RecordReceived, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.relay_records import Bind, Bound, Candidates, Record, wrap
from uavlinkd.relay import service
from uavlinkd.relay.direct_search import DirectSearch, OwnSocket
from uavlinkd.relay.service import BINDS_BURST, LOOK_S

FLEET = 50
SECONDS = 10
VICTIM = "203.0.113.99"
ELSEWHERE = Path(0, ("203.0.113.7", 4000))
DATA = b"\x40datagram"
IP_BYTES = 48
"""Of the headers of IPv6 and UDP."""


@pytest.fixture
def relay() -> FuzzedRelay:
    """A relay with three members that are up, which may each ask for three."""
    relay = FuzzedRelay()
    relay.set_members(0b111, 3)
    relay.pass_time(2.0)
    assert all(member.peer.is_up for member in relay.members)
    return relay


def connect(relay: FuzzedRelay) -> tuple[int, int]:
    """Connect the first two members along their first paths. The handle of each."""
    one, other = relay.members[:2]
    for member, key in ((one, KEYS[2]), (other, KEYS[1])):
        relay.send(member, member.node.send_record(member.peer, RELAY_AT[0], Bind((key,)), relay.now))
        relay.settle()
    return one.handles[RELAY_AT[0]][KEYS[2]][0], other.handles[RELAY_AT[0]][KEYS[1]][0]


def sealed(relay: FuzzedRelay, number: int, record: Record) -> bytes:
    """The envelope of one member with this record."""
    session = relay.members[number].peer.sessions.current
    assert session is not None
    return session.seal(session.sealed_record(record.encode()), relay.now)


# Candidates.


@pytest.mark.long
def test_captured_member_of_a_fleet_of_50_causes_at_most_the_buckets_at_a_victim() -> None:
    """It names other ports of one victim ten times a second to each of its 49 peers, which ask at most 80, then one a
    second. The total of section 22: 3,920 questions of some 45 bytes at once, then 49 a second.
    """
    questions: list[list[Transmit]] = []
    for _ in range(FLEET - 1):
        pair = Pair(LINK, LINK)
        pair.a.peer_at = pair.b.peer_at = relayed(0, "vps", 7)
        for side in (pair.a, pair.b):
            side.configure_path(0.0)
        pair.establish()
        search = DirectSearch(pair.a.node, pair.a.peer, 0.0)
        search.set_own((HOME_A,), [OwnSocket(0, False, (), leads_to_mesh)], (), 0.0)
        sent: list[Transmit] = []
        for number in range(10 * SECONDS):
            places = tuple((VICTIM, 2000 + (2 * number + port) % 60000) for port in range(c.CANDIDATES))
            received = RecordReceived(pair.a.peer, pair.a.peer_at, Candidates(places), number)
            search.on_record(received, number / 10)
            sent += [
                transmit for transmit in of(search.do_due(number / 10), Transmit) if not transmit.path.is_relayed
            ]
        questions.append(sent)
    most = c.CANDIDATE_QUESTIONS + c.CANDIDATE_QUESTIONS_PER_S * SECONDS
    assert all(c.CANDIDATE_QUESTIONS <= len(sent) <= most for sent in questions)
    assert {transmit.path.host for sent in questions for transmit in sent} == {VICTIM}
    at_once = sum(min(len(sent), int(c.CANDIDATE_QUESTIONS)) for sent in questions)
    assert at_once == (FLEET - 1) * c.CANDIDATE_QUESTIONS == 3920
    assert max(len(transmit.datagram) for sent in questions for transmit in sent) <= 50


# The relay.


def test_spoofed_sources_move_no_path(relay: FuzzedRelay) -> None:
    """An attacker repeats a member's datagrams from elsewhere, faster than it, and sends data with its handle.
    The data for the member goes where the member is.
    """
    to_other, to_one = connect(relay)
    one = relay.members[0]
    for transmit in of(one.node.send_record(one.peer, RELAY_AT[0], Bind((KEYS[2],)), relay.now), Transmit):
        relay.arrive(transmit.datagram, ELSEWHERE)
    for recorded in one.recorded:
        relay.arrive(recorded, ELSEWHERE)
    relay.arrive(wrap(to_other, DATA), ELSEWHERE)
    assert relay.forwarded == []
    relay.settle()
    relay.pass_time(8.0)
    relay.arrive(wrap(to_one, DATA), HOMES[1][0])
    assert relay.forwarded == [(wrap(to_other, DATA), HOMES[0][0])]
    assert one.peer.is_up
    assert ELSEWHERE not in relay.service.bindings.paths_of(KEYS[1])


def test_path_that_the_core_gave_up_is_found_in_turn(relay: FuzzedRelay, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large relay looks at a part of its members each time, so the last one is found after as many parts."""
    connect(relay)
    monkeypatch.setattr(service, "CHECKED_PER_S", 1)
    relay.service.members[KEYS[2]].peer.paths.clear()
    routes = []
    for _ in relay.members:
        relay.service.do_housekeeping(relay.now)
        routes.append(len(relay.service.forwarding))
    assert routes == [2, 0, 0]


def test_address_that_a_nat_gave_up_keeps_no_connection(relay: FuzzedRelay) -> None:
    """It would take one from the new address of the member. A member that is still there binds again."""
    connect(relay)
    failed = PathStateChanged(relay.service.members[KEYS[1]].peer, HOMES[0][0], False, "unanswered")
    relay.service.on_event(failed, relay.now)
    relay.service.settle(relay.now)
    relay.settle()
    assert len(relay.service.forwarding) == 0
    assert relay.members[1].handles[RELAY_AT[0]][KEYS[1]] == []
    to_other, to_one = connect(relay)
    relay.arrive(wrap(to_one, DATA), HOMES[1][0])
    assert relay.forwarded == [(wrap(to_other, DATA), HOMES[0][0])]


def test_unproven_address_gets_no_report(relay: FuzzedRelay) -> None:
    """A bind of 16 keys would be answered with 563 bytes. Its path is asked first, with no more than came."""
    connect(relay)
    relay.members[0].bounds.clear()
    keys = (KEYS[2], *(bytes((number,)) * c.KEY_BYTES for number in range(1, c.KEYS_PER_BIND)))
    bind = sealed(relay, 0, Bind(keys))
    relay.arrive(bind, ELSEWHERE)
    answers = [datagram for datagram, path in relay._wire if path == ELSEWHERE]
    assert sum(map(len, answers)) <= len(bind)
    assert ELSEWHERE not in relay.service.bindings.paths_of(KEYS[1])


def test_strangers_get_nothing_and_change_nothing(relay: FuzzedRelay) -> None:
    """Whatever they send: data with valid handles, envelopes, MAVLink. Each datagram is counted."""
    handles = connect(relay)
    counted = relay.node.drops.total() + relay.service.forwarding.dropped.total()
    sent = 0
    for stranger in STRANGERS:
        starts = [wrap(handle, DATA) for handle in handles] + [
            b"\x50",
            b"\xfd" + bytes(20),
            b"\x01" + bytes(146),
            b"",
        ]
        for datagram in starts:
            relay.arrive(datagram, stranger)
            sent += 1
    assert relay.forwarded == []
    assert relay.node.drops.total() + relay.service.forwarding.dropped.total() == counted + sent
    relay.check_bounds()


def test_ten_thousand_requested_bindings_take_bounded_memory(relay: FuzzedRelay) -> None:
    """A captured member asks for 10,000 keys in a second, along paths that it invents too."""
    handle, _ = connect(relay)
    keys = [number.to_bytes(c.KEY_BYTES, "big") for number in range(10_000)]
    binds = [Bind(tuple(keys[at : at + c.KEYS_PER_BIND])) for at in range(0, len(keys), c.KEYS_PER_BIND)]
    datagrams = [sealed(relay, 2, bind) for bind in binds]
    relay.settle()
    tracemalloc.start()
    try:
        for number, datagram in enumerate(datagrams):
            path = Path(0, ("203.0.113.5", number)) if number % 2 else HOMES[2][0]
            relay.arrive(datagram, path)
            relay._wire.clear()
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 1_000_000
    assert relay.service.members[KEYS[3]].binds_ignored >= len(binds) - BINDS_BURST - 1
    assert relay.service.bindings.peers_of(KEYS[3]) == (0, 3)
    relay.check_bounds()
    relay.arrive(wrap(handle, DATA), HOMES[0][0])
    assert len(relay.forwarded) == 1, "another member is slowed"


def test_member_that_asks_along_another_relay_harms_no_report(relay: FuzzedRelay) -> None:
    """Such a path has no address that a report could name. The bind has no effect."""
    peer = relay.service.members[KEYS[1]].peer
    along = relayed(0, "other", 7)
    relay.node.set_paths(peer, [along], relay.now)
    relay.settle()
    assert peer.paths.find(along) is not None
    received = RecordReceived(peer, along, Bind((KEYS[2],)), 1)
    assert relay.service.on_record(received, relay.now) is DropReason.UNEXPECTED_RECORD
    assert not relay.service.is_due


def test_binds_along_unproven_paths_wait_only_while_the_paths_have_slots(relay: FuzzedRelay) -> None:
    """A captured member names 200 addresses: what waits is bounded, and ends with the slot, not after 5 s."""
    service, peer = relay.service, relay.service.members[KEYS[3]].peer
    for number in range(200):
        bind = sealed(relay, 2, Bind((KEYS[1],)))
        relay.arrive(bind, Path(0, ("203.0.113.5", 1000 + number)))
    waiting = service._asked[KEYS[3]]
    assert 0 < len(waiting) <= c.CONFIGURED_PATHS + c.LEARNED_PATHS
    counted = list(service.count_drops())
    count = len(waiting)
    peer.paths.clear()
    service.settle(relay.now + LOOK_S)
    assert not service.is_due
    assert list(service.count_drops()) == [(DropReason.UNEXPECTED_RECORD, "member2", count)]
    assert relay.node.drops[DropReason.UNEXPECTED_RECORD] == sum(before for _, _, before in counted) + count


def test_each_bind_that_has_no_effect_has_a_reason(relay: FuzzedRelay) -> None:
    """Above the limits; and records that are not for a relay."""
    service, peer = relay.service, relay.service.members[KEYS[3]].peer
    at = HOMES[2][0]

    def ask(record: Record) -> DropReason | None:
        return service.on_record(RecordReceived(peer, at, record, 1), relay.now)

    assert ask(Bind(KEYS[:3])) is None
    assert ask(Bind((bytes(32),))) is DropReason.RECORD_OVER_LIMIT, "it may ask for three"
    assert ask(Bound("203.0.113.1", 4000, ((KEYS[1], 1),))) is DropReason.UNEXPECTED_RECORD
    assert ask(Candidates((("203.0.113.1", 4000),))) is DropReason.UNEXPECTED_RECORD
    results = [ask(Bind((KEYS[1],))) for _ in range(BINDS_BURST)]
    assert results.count(DropReason.RECORD_OVER_LIMIT) == 2


def test_wishes_that_wait_for_their_path_count_when_they_are_too_many(
    relay: FuzzedRelay, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three at once while they wait, and the limit of the member when the path is validated."""
    service, peer = relay.service, relay.service.members[KEYS[3]].peer
    state = next(state for state in peer.paths.states if state.path == HOMES[2][0])
    keys = tuple(bytes((number,)) * 32 for number in range(8))

    def ask(*keys: bytes) -> DropReason | None:
        return service.on_record(RecordReceived(peer, state.path, Bind(keys), 1), relay.now)

    assert ask(*keys[:2]) is None
    with monkeypatch.context() as unproven:
        unproven.setattr(PathState, "is_validated", False)
        assert ask(*keys[4:]) is DropReason.RECORD_OVER_LIMIT
    service.settle(relay.now + LOOK_S)
    assert list(service.count_drops()) == [(DropReason.RECORD_OVER_LIMIT, "member2", 1)]
    assert service.bindings.peers_of(KEYS[3]) == (0, 3)


def test_removed_member_with_several_paths_is_cut_off(relay: FuzzedRelay) -> None:
    """Whatever handle it tries afterwards, from any of its addresses."""
    bindings = relay.service.bindings
    paths = {member: [Path(0, (f"203.0.113.{member}", port)) for port in (1, 2, 3)] for member in (1, 2)}
    for one, other in ((1, 2), (2, 1)):
        for path in paths[one]:
            relay.service._apply(bindings.bind(KEYS[one], path, [KEYS[other]], relay.now))
    assert len(relay.service.forwarding) == 2 * c.HANDLES_PER_PAIR
    relay.set_members(0b110, 3)
    for path in paths[1]:
        for handle in range(2**16):
            relay.service.forwarding.take(path.socket, wrap(handle, DATA), path.address)
    assert relay.forwarded == []
    assert len(relay.service.forwarding) == 0


def test_drops_of_a_removed_member_are_reported(relay: FuzzedRelay) -> None:
    """Also those since the last report."""
    to_other, _ = connect(relay)
    for _ in range(100):
        relay.arrive(wrap(to_other, DATA), HOMES[0][0])
    over_limit = relay.service.members[KEYS[1]].meter.over_limit
    assert over_limit > 0
    relay.set_members(0b110, 3)
    reports = [(DropReason.RELAY_OVER_LIMIT, "member0", over_limit)]
    assert [report for report in relay.service.count_drops() if report[1]] == reports
    assert not list(relay.service.count_drops())
