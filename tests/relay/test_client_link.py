"""When a member binds, which handles it takes, and when it asks its relay: with literal times, without sockets."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.protocol.harness import AT_B, ELSEWHERE, KEY_B, Pair, quiet
from uavlinkd.config.model import RelayConfig
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import WAITING, Bind, Bound, Record, wrap
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.relay.client_link import BIND_SOON_S, RelayHandles, RelayLink

LINK = quiet(features=c.FEATURE_RECORDS)
ONE, TWO = bytes([7]) * 32, bytes([8]) * 32
ELSE = bytes([9]) * 32
T = 10.0


class RelayMember:
    """Alpha is the member, beta the relay: a session, and one path that works."""

    def __init__(self, on_change: Callable[[set[bytes], float], None] = lambda *_: None) -> None:
        self.pair = Pair(LINK, LINK)
        node = self.pair.a.node
        node.remove_peer(self.pair.a.peer, 0.0)
        self.handles = RelayHandles()
        config = RelayConfig(PeerSettings("relay vps", KEY_B.public, None, LINK), ())
        self.link = RelayLink(config, node, self.handles, on_change, 0.0)
        self.pair.a.peer_name = self.link.name
        self.link.set_paths([AT_B], 0.0)
        self.pair.establish()
        assert self.pair.carries(0.0)

    def received(self, outputs: list[o.Output], now: float) -> list[Record]:
        """The records that the relay gets by these outputs."""
        return [
            output.record
            for sent in outputs
            if isinstance(sent, o.Transmit)
            for output in self.pair.b.receive(sent.datagram, now)
            if isinstance(output, o.RecordReceived)
        ]


class Scene(RelayMember):
    """Two peers use the relay."""

    def __init__(self) -> None:
        self.changed: list[set[bytes]] = []
        super().__init__(lambda keys, _: self.changed.append(keys))
        self.link.follow([ONE, TWO])
        self.order = 0

    def binds(self, now: float) -> list[tuple[bytes, ...]]:
        """The keys of each bind that the relay gets now."""
        return [record.keys for record in self.received(self.link.do_due(now), now) if isinstance(record, Bind)]

    def bound(
        self, now: float, *entries: tuple[bytes, int], order: int | None = None, path: Path = AT_B
    ) -> DropReason | None:
        """The relay's record. Returns why it has no effect."""
        self.order += 1
        record = Bound("198.51.100.1", 4000, entries)
        return self.link.on_record(
            o.RecordReceived(self.link.peer, path, record, self.order if order is None else order), now
        )


@pytest.fixture
def scene() -> Scene:
    """A member with a session."""
    return Scene()


def test_bind_to_a_busy_relay_is_repeated_later(scene: Scene) -> None:
    """After two round trips, at most as late as any repeat."""
    for handshake_s, repeat_s in ((0.2, 0.4), (2.0, c.BIND_RETRY_S)):
        scene.link.peer.handshake_s = handshake_s
        scene.link.follow([])
        scene.link.follow([ONE])
        assert scene.binds(T)
        assert scene.link.next_at == pytest.approx(T + repeat_s)


def test_bind_that_is_answered_is_repeated_rarely(scene: Scene) -> None:
    """More often while a peer has not asked for this one."""
    assert scene.binds(T)
    scene.bound(T, (ONE, 5))
    assert scene.link.next_at == pytest.approx(T + BIND_SOON_S)  # the other key is not answered
    scene.bound(T, (TWO, WAITING))
    assert scene.link.next_at == T + c.BIND_WAITING_S
    scene.bound(T + 1, (ONE, 6))  # a report: the relay made another handle for it
    assert scene.link.next_at == T + c.BIND_WAITING_S
    assert scene.binds(T + c.BIND_WAITING_S)
    scene.bound(T + 6, (ONE, 6), (TWO, 6))
    assert scene.link.next_at == T + 6 + c.BIND_INTERVAL_S


def test_peer_that_was_added_before_the_answer_is_bound_at_once(scene: Scene) -> None:
    """The answer is to the bind before, which did not name it."""
    assert scene.binds(T)
    scene.link.follow([ONE, TWO, ELSE])
    scene.bound(T, (ONE, 5), (TWO, 6))
    assert scene.binds(T) == [(ONE, TWO, ELSE)]


def test_path_that_works_again_is_bound_at_once(scene: Scene) -> None:
    """The relay may have forgotten it meanwhile. Another path has its own time."""
    assert scene.binds(T)
    scene.bound(T, (ONE, 5), (TWO, 6))
    scene.link.on_event(o.PathStateChanged(scene.link.peer, ELSEWHERE, True, "answered"), T)
    assert scene.link.next_at == T + c.BIND_INTERVAL_S
    scene.link.on_event(o.PathStateChanged(scene.link.peer, AT_B, True, "answered"), T)
    assert scene.binds(T)


def test_data_with_an_unknown_handle_causes_a_bind(scene: Scene) -> None:
    """A bound record was lost. An attacker that sends such data causes a few binds a second, and only at a relay."""
    assert scene.binds(T)
    scene.bound(T, (ONE, 5), (TWO, 6))
    scene.link.on_unknown_handle(ELSEWHERE, T + 1)
    assert not scene.binds(T + 1)
    binds = 0
    for number in range(1000):
        now = T + 1 + number / 1000
        scene.link.on_unknown_handle(AT_B, now)
        if scene.binds(now):
            binds += 1
            scene.bound(now, (ONE, 5), (TWO, 6))
    assert binds == 4
    binds = 0
    for number in range(90):
        scene.link.on_unknown_handle(AT_B, T + 2.5 + number / 1000)
        binds += bool(scene.binds(T + 2.5 + number / 1000))
    assert binds == 1, "no other one before an answer, but the usual repeats"
    scene.bound(T + 2.6, (ONE, 5), (TWO, 6))
    many = [ONE, TWO, *(bytes((number,)) * 32 for number in range(100, 130))]
    scene.link.follow(many)
    assert len(scene.binds(T + 3)) == 2
    for first in (0, 16):
        scene.bound(T + 3, *((key, 50 + number) for number, key in enumerate(many[first : first + 16], first)))
    scene.link.on_unknown_handle(AT_B, T + 3.4)
    assert not scene.binds(T + 3.4), "two records cost twice as much"
    scene.link.on_unknown_handle(AT_B, T + 3.5)
    assert len(scene.binds(T + 3.5)) == 2


def test_handles_are_paths_until_the_relay_ends_them(scene: Scene) -> None:
    """A record replaces the handles of the keys that it names, and of no others. A relay that is lost ends all."""
    assert scene.binds(T)
    scene.bound(T, (ONE, 5), (ONE, 6), (TWO, 7))
    assert scene.link.paths_to(ONE) == [[relayed(0, "vps", 5), relayed(0, "vps", 6)]]
    scene.bound(T, (ONE, 8))
    assert scene.link.paths_to(ONE) == [[relayed(0, "vps", 8)]]
    assert scene.link.paths_to(TWO) == [[relayed(0, "vps", 7)]]
    assert scene.handles.wrap(b"\x40", relayed(0, "vps", 5)) is None
    scene.bound(T, (ONE, WAITING))
    assert scene.link.paths_to(ONE) == [[]]
    assert scene.changed == [{ONE, TWO}, {ONE}, {ONE}]
    scene.link.on_event(o.PeerLost(scene.link.peer, c.BIND_LIFETIME_S), T + c.BIND_LIFETIME_S)
    assert scene.changed[-1] == {ONE, TWO}
    assert scene.link.paths_to(TWO) == [[]]


def test_older_record_about_a_key_is_dropped(scene: Scene) -> None:
    """The network may reorder records. What such a record says of other keys counts."""
    assert scene.binds(T)
    assert scene.bound(T, (ONE, 5), order=10) is None
    assert scene.bound(T, (ONE, 4), (TWO, 7), order=9) is None
    assert scene.bound(T, (ONE, 3), (TWO, 2), order=8) is DropReason.OLD_RECORD
    assert scene.link.paths_to(ONE) == [[relayed(0, "vps", 5)]]
    assert scene.link.paths_to(TWO) == [[relayed(0, "vps", 7)]]


def test_handle_for_a_key_that_was_not_asked_for_is_dropped(scene: Scene) -> None:
    """A relay cannot attract traffic for others, nor assign handles without bound or on an unknown path."""
    assert scene.binds(T)
    assert scene.bound(T, (ELSE, 5)) is DropReason.UNEXPECTED_RECORD
    assert scene.bound(T, (ONE, 5), path=Path(3, ("203.0.113.9", 1))) is DropReason.UNEXPECTED_RECORD
    bind = o.RecordReceived(scene.link.peer, AT_B, Bind((ONE,)), 99)
    assert scene.link.on_record(bind, T) is DropReason.UNEXPECTED_RECORD, "a member is not a relay"
    assert scene.changed == []
    assert scene.link.paths_to(ELSE) == scene.link.paths_to(ONE) == [[]]
    scene.bound(T, *((ONE, handle) for handle in range(1, 20)))
    assert len(scene.link.paths_to(ONE)[0]) == c.HANDLES_PER_PAIR


def test_relay_is_asked_along_the_socket_of_the_path_that_failed(scene: Scene) -> None:
    """At most every quarter of a second, however many paths fail. Of what fails meanwhile it is asked then: a NAT may
    have forgotten the relay since it answered.
    """
    assert scene.binds(T)
    scene.bound(T, (ONE, 5), (TWO, 6))
    scene.link.ask(relayed(0, "vps", 5))
    assert scene.link.do_due(T + 1)
    for tenth in (1, 2):
        scene.link.ask(relayed(0, "vps", 6))
        assert not scene.link.do_due(T + 1 + tenth / 10)
    assert scene.link.next_at == T + 1.25
    assert scene.link.do_due(T + 1.25)
    assert scene.link.next_at > T + 1.25
    scene.link.ask(relayed(1, "vps", 5))
    assert not scene.link.do_due(T + 2)


# Handles on paths to relays: only those that were assigned lead somewhere, in both directions.

LTE, MESH = Path(0, ("203.0.113.1", 5790)), Path(1, ("203.0.113.1", 5790))
ENVELOPE = b"\x40envelope"


Assignment = tuple[str, Path, list[int]]
assignments: st.SearchStrategy[Assignment] = st.tuples(
    st.sampled_from(("vps", "hostile")),
    st.sampled_from((LTE, MESH, Path(0, ("203.0.113.2", 5790)))),
    st.lists(st.integers(1, 3), max_size=3),
)


@settings(max_examples=75)
@given(st.lists(assignments, max_size=12))
def test_random_assignments_follow_the_rules(history: list[Assignment]) -> None:
    """Both directions agree. A relay loses no handle to another one, and gets each that no other has then."""
    paths, wanted, had = RelayHandles(), dict[tuple[str, Path], list[int]](), set[tuple[str, Path, int]]()
    for relay, at, handles in history:
        paths.assign(relay, at, handles)
        wanted[relay, at] = handles
        now = {
            (name, place, handle)
            for (name, place), those in wanted.items()
            for handle in those
            if paths.unwrap(place.socket, wrap(handle, ENVELOPE), place.address)
            == (ENVELOPE, relayed(place.socket, name, handle))
        }
        for name, place, handle in now:
            assert paths.wrap(ENVELOPE, relayed(place.socket, name, handle)) == (
                wrap(handle, ENVELOPE),
                place.address,
            )
        assert len(paths._inward) == len(paths._outward) == len(now)
        assert all(handle not in wanted[name, place] for name, place, handle in had - now), "a handle was lost"
        names = {(name, place.socket, handle) for name, place, handle in now}
        places = {(place, handle) for _, place, handle in now}
        for handle in handles:
            assert (relay, at.socket, handle) in names or (at, handle) in places, "a handle leads nowhere"
        had = now


def test_path_to_a_relay_is_never_relayed() -> None:
    """A relay sends its own envelopes along a handle, and assigns more there: they would lead to no address."""
    paths = RelayHandles()
    paths.assign("vps", LTE, [7])
    paths.assign("vps", relayed(0, "vps", 7), [8])
    assert paths.wrap(ENVELOPE, relayed(0, "vps", 8)) is None
