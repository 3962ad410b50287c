"""Peers that meet at relays, behind NATs: random histories, and what is lost when relays, networks or NATs fail."""

from __future__ import annotations

import os
from collections.abc import Sequence

import pytest

from tests.network.histories import play
from tests.network.network import Network
from tests.network.plans import RELAYS
from tests.network.relayed import FAILURES, RADIO, back_s, couple, first_frame_s, one_network_of_two_dies, rebound_s
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import Path
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.relay.bindings import Bindings, Changes

TRIES = int(os.environ.get("UAVLINKD_RELAY_TRIES", "2"))
SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "8"))
FIRST_FRAME_S = 1.0
BACK_S = 2.0
STREAM_GAP_S = 0.5


@pytest.mark.parametrize("batch", [pytest.param(0, marks=pytest.mark.long), 1])
def test_links_along_relays_are_back_soon_after_any_history(batch: int) -> None:
    """Relays die, NATs forget, members roam, data is replayed and forged: links are back. Filters hold."""
    for seed in (19, *range(20, 20 + SEEDS // 4))[batch::2]:
        played = play(seed, RELAYS)
        assert not played.violations, played.violations[0][1]
        assert played.judged
        assert played.critical_judged
        assert played.relayed > 100
        assert played.filters_known > 0


@pytest.mark.parametrize("seed", range(TRIES))
def test_first_frame_crosses_soon_after_both_reached_the_relay(seed: int) -> None:
    """Whichever comes first."""
    assert first_frame_s(seed) < FIRST_FRAME_S


@pytest.mark.parametrize("off_s", [0.0, 0.5, 20.0])
def test_link_is_back_soon_after_the_start_of_a_relay_that_was_killed(off_s: float) -> None:
    """The relay has forgotten all."""
    assert max(back_s(seed, off_s) for seed in range(TRIES)) < BACK_S


def test_first_frame_after_a_silence_soon_passes_a_relay_that_was_killed() -> None:
    """The other end sends nothing either, and no keepalive is due."""
    assert max(back_s(seed, is_silent=True) for seed in range(3 * TRIES)) < BACK_S


def test_absent_peer_is_bound_with_each_question_to_the_relay(monkeypatch: pytest.MonkeyPatch) -> None:
    """No echo request would show that a NAT has given this member another address. One that is up is bound once."""
    asked: list[bool] = []
    monkeypatch.setattr(RelayLink, "ask", lambda _link, _path, *, binds=True: asked.append(binds))
    with Network("asks", RADIO) as network:
        pair = couple(network)
        pair.start()
        network.run(30)
        assert asked.count(False) > asked.count(True) > 0
        pair.station.stop()
        network.run(15)
        asked.clear()
        network.run(5)
        assert asked.count(True) >= 4
        assert all(asked)


@pytest.mark.parametrize("of_station", [False, True], ids=["vehicle", "station"])
def test_link_is_back_soon_after_a_nat_has_forgotten_its_mappings(*, of_station: bool) -> None:
    """The member has another address at the relay, and does not know it."""
    assert max(rebound_s(seed, of_station=of_station) for seed in range(TRIES)) < BACK_S


@pytest.mark.parametrize("name", FAILURES)
def test_no_critical_frame_is_lost_when_a_relay_or_a_network_dies(name: str) -> None:
    """Another one carries copies. The stream stops shortly."""
    for seed in range(TRIES):
        result = FAILURES[name](seed)
        print(name, result)
        assert result.critical_lost == 0
        assert result.critical_sent > 100
        assert result.was_real
        assert result.stream_gap_s <= STREAM_GAP_S


@pytest.mark.parametrize("filters_by_port", [False, True], ids=["by address", "by port"])
def test_member_sees_how_its_nat_filters(*, filters_by_port: bool) -> None:
    """Through a relay that loses nothing: in one round trip, or after all tries. No path is made or lost."""
    with Network(f"filters {filters_by_port}", RADIO) as network:
        pair = couple(network)
        pair.vehicle.nats[0].filters_by_port = filters_by_port
        pair.begin()
        network.run(2.0)
        vehicle, (relay,) = pair.vehicle, pair.relays
        assert vehicle.relays is not None
        tests = vehicle.relays.filter_tests
        paths = [state.path for state in vehicle.relays.by_name[relay.name].peer.paths.states]
        vehicle.test_filters()
        began = network.now
        network.run_until(tests.ended.is_set, within_s=c.FILTER_TRIES * c.FILTER_TRY_MOST_S)
        assert [result.passes for result in tests.results] == [not filters_by_port]
        assert len(relay.new_ports) == (3 if filters_by_port else 1)
        assert network.now - began <= (0.95 if filters_by_port else 0.15)
        assert [state.path for state in vehicle.relays.by_name[relay.name].peer.paths.states] == paths
        assert not vehicle.drops[DropReason.RELAY_UNEXPECTED_TOKEN]


def test_relay_that_forges_the_addresses_of_its_members_prevents_no_direct_path() -> None:
    """Each member receives envelopes of the relay from the address of the other one, from the first session on."""
    with Network("forged by a relay", RADIO) as network:
        pair = couple(network, searches=True)
        pair.start()
        pair.talk()
        (relay,), members = pair.relays, (pair.vehicle, pair.station)
        forged = 0
        while not pair.is_direct() and network.now < 5.0:
            network.run(0.01)
            assert relay.node is not None
            peers = [relay.node.peers.get(member.name) for member in members]
            for member, peer, other in zip(members, peers, reversed(peers), strict=True):
                if peer is not None and (session := peer.sessions.current) is not None and other is not None:
                    envelope = session.seal(b"", relay.local_now)
                    for state in other.paths.states:
                        member.receive(envelope, state.path)
                        forged += 1
        assert forged > 20
        assert pair.is_direct()


def test_one_copy_for_each_relay_is_too_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes to one network of the peer: the figures show the loss when that network dies."""
    monkeypatch.setattr(c, "RELAYED_COPIES", 1)
    assert sum(one_network_of_two_dies(seed).critical_lost for seed in range(2))


def test_relay_that_connects_members_that_did_not_both_ask_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted: one wish is enough."""
    bind = Bindings.bind

    def bind_both(bindings: Bindings, member: bytes, path: Path, keys: Sequence[bytes], now: float) -> Changes:
        for key in keys:
            for its_path in bindings.paths_of(key):
                bind(bindings, key, its_path, [member], now)
        return bind(bindings, member, path, keys, now)

    monkeypatch.setattr(Bindings, "bind", bind_both)
    violations = play(21, RELAYS).violations
    assert violations
    assert "is not asked for" in violations[0][1] or "_outward" in violations[0][1]
