"""Frames go where their target was received, once, and never in circles."""

from __future__ import annotations

from collections import Counter
from itertools import count
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.mavlink import routing
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.routing import Router, Unrouted

_serial = count()


def frame(system: int = 1, component: int = 1, *, to: tuple[int, int] = (0, 0)) -> Frame:
    """A frame with these header facts. Its bytes are its own."""
    return Frame(b"%d" % next(_serial), Header(0, system, component, *to))


def router(*locals_: str, peers: tuple[str, ...] = (), relays: bool = False) -> Router[str]:
    made: Router[str] = Router(relays=relays)
    for port in (*locals_, *peers):
        made.add_port(port, is_peer=port in peers)
    return made


def test_silent_client_gets_no_broadcasts_of_other_clients() -> None:
    """It gets broadcasts of peers, and frames with a target, also where every port is tried."""
    r = router("gcs", "gone", "autopilot", peers=("p",))
    r.refresh(0.0)
    assert r.valid_until > 0
    r.set_silent("gone", is_silent=True)
    assert r.valid_until < 0
    assert r.route(frame(), "gcs", 0.0) == ("autopilot", "p")
    assert r.route(frame(), "p", 0.0) == ("gcs", "gone", "autopilot")
    assert r.route(frame(to=(9, 1)), "gcs", 0.0) == ("gone", "autopilot", "p")
    r.set_silent("gone", is_silent=False)
    assert r.route(frame(), "gcs", 0.0) == ("gone", "autopilot", "p")
    r.set_silent("gone", is_silent=True)
    r.remove_port("gone")
    r.add_port("gone")
    assert r.route(frame(), "gcs", 0.0) == ("autopilot", "p", "gone")


def test_route_ages_out() -> None:
    """A system that has been silent for the lifetime is unknown again, and not before. Each frame renews it."""
    r = router("gcs", "autopilot", "camera")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(1, 100), "camera", 60.0)
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 119.0) == ("autopilot",)
    r.route(frame(255, 190), "gcs", 136.0)
    assert (r.addresses("autopilot"), r.addresses("camera")) == ([], [(1, 100)])
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 136.0) == ("camera",)
    for second in range(140, 500, 60):
        r.route(frame(1, 1), "autopilot", float(second))
    assert r.route(frame(255, 190, to=(1, 0)), "gcs", 499.0) == ("autopilot",)


def test_removed_port_is_forgotten() -> None:
    """A port that is gone gets nothing, and neither does who was behind it."""
    r = router("gcs", "autopilot", "other")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0)
    r.remove_port("autopilot")
    r.remove_port("autopilot")
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0) == ("other",)
    assert r.route(frame(255, 190), "gcs", 0.0) == ("other",)
    with pytest.raises(KeyError):
        r.route(frame(), "autopilot", 0.0)


def test_new_port_is_served_at_once() -> None:
    """Remembered decisions do not hide a port that was added, or a system that was received, after them."""
    r = router("a", "b")
    assert r.route(frame(5, 1), "a", 0.0) == ("b",)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ("b",)
    r.add_port("c")
    assert r.route(frame(5, 1), "a", 0.0) == ("b", "c")
    r.route(frame(6, 1), "c", 0.0)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ("c",)
    r.add_port("c", is_peer=True)
    r.add_port("a", is_peer=True)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ()


def test_invented_addresses_crowd_out_only_their_own_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded per port: invented systems displace only systems of the same port."""
    monkeypatch.setattr(routing, "MAX_ADDRESSES_PER_PORT", 8)
    r = router("gcs", "autopilot", "hostile")
    r.route(frame(1, 1), "autopilot", 0.0)
    for system in range(2, 250):
        r.route(frame(system, 1), "hostile", 0.0)
    assert len(r.addresses("hostile")) == 8
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0) == ("autopilot",)
    assert r.route(frame(255, 190, to=(2, 1)), "gcs", 0.0) == ("autopilot", "hostile")
    assert r.route(frame(255, 190, to=(249, 1)), "gcs", 0.0) == ("hostile",)


def test_least_recently_received_address_is_forgotten_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the first one learnt: a vehicle that keeps sending outlives addresses that were received once."""
    monkeypatch.setattr(routing, "MAX_ADDRESSES_PER_PORT", 8)
    r = router("gcs", "vehicles")
    for system in range(1, 9):
        r.route(frame(system, 1), "vehicles", float(system))
    for system in range(101, 108):
        r.route(frame(1, 1), "vehicles", float(system))
        r.route(frame(system, 1), "vehicles", float(system))
        assert r.route(frame(255, 190, to=(1, 1)), "gcs", float(system)) == ("vehicles",)
    assert r.addresses("vehicles") == [(1, 1), *((system, 1) for system in range(101, 108))]


PORTS = st.sampled_from(["a", "b", "p", "q"])
ADDRESSES = st.tuples(st.integers(0, 3), st.integers(0, 2))
STEPS = st.lists(st.tuples(PORTS, ADDRESSES, ADDRESSES, st.floats(0, 4)), max_size=60)
Step = tuple[str, tuple[int, int], tuple[int, int], float]


@given(STEPS, st.booleans(), st.sampled_from(["", "p", "bpq"]))
@settings(max_examples=75)
def test_router_does_what_the_rules_say(steps: list[Step], relays: bool, without: str) -> None:
    """Against a model that remembers everything and applies the rules to it."""
    with patch.object(routing, "ROUTE_LIFETIME_S", 1e9):
        _compare(steps, relays, without)


def _compare(steps: list[Step], relays: bool, without: str) -> None:
    ports = [port for port in "abpq" if port not in without]
    r: Router[str] = Router(relays=relays)
    for port in ports:
        r.add_port(port, is_peer=port in "pq")
    received: set[tuple[str, tuple[int, int]]] = set()
    unrouted: Counter[Unrouted] = Counter()
    now = 0.0
    for source, sender, to, pause in steps:
        if source not in ports:
            continue
        now += pause
        got = r.route(frame(*sender, to=to), source, now)
        if sender[0] != 0:
            received.add((source, sender))
        others = [p for p in ports if p != source and (relays or not (p in "pq" and source in "pq"))]
        at_system = {p for p, address in received if address[0] == to[0]}
        at_component = at_system if to[1] == 0 else {p for p, address in received if address == to}
        wanted = set(ports) if to[0] == 0 else at_component or at_system
        if not wanted - {source}:
            wanted = set(ports)
        assert got == tuple(p for p in others if p in wanted)
        if not got:
            unrouted[Unrouted.NO_OTHER_PORT if to[0] == 0 or at_system else Unrouted.UNKNOWN_TARGET] += 1
    assert r.unrouted == unrouted
    for port in ports:
        assert r.addresses(port) == sorted(address for at, address in received if at == port)
