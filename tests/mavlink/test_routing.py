"""Frames go where their target was heard, once, and never in circles."""

from __future__ import annotations

from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.mavlink import routing
from uavlinkd.mavlink.frames import Frame, Header
from uavlinkd.mavlink.routing import Router, Unrouted

_serial = count()


def frame(system: int = 1, component: int = 1, *, to: tuple[int, int] = (0, 0), raw: bytes | None = None) -> Frame:
    """A frame with these header facts; its bytes are its own unless given."""
    own = b"%d" % next(_serial) if raw is None else raw
    return Frame(own, Header(0, system, component, to))


def router(*locals_: str, peers: tuple[str, ...] = (), **options: float) -> Router[str]:
    relays, floods = bool(options.pop("relays", False)), bool(options.pop("floods_unknown", False))
    made: Router[str] = Router(relays=relays, floods_unknown=floods, **options)
    for port in locals_:
        made.add_port(port)
    for port in peers:
        made.add_port(port, is_peer=True)
    return made


def test_broadcast_goes_to_all_other_ports() -> None:
    """Without a target a frame goes everywhere but back, in the ports' order."""
    r = router("a", "b", peers=("p", "q"))
    assert r.route(frame(), "a", 0.0) == ("b", "p", "q")
    assert r.route(frame(), "b", 0.0) == ("a", "p", "q")


def test_target_is_reached_where_it_was_heard() -> None:
    """A frame for a component goes to that component's port alone."""
    r = router("gcs", "autopilot", "camera", "other")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(1, 100), "camera", 0.0)
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0) == ("autopilot",)
    assert r.route(frame(255, 190, to=(1, 100)), "gcs", 0.0) == ("camera",)


def test_all_components_of_a_system_are_reached() -> None:
    """Component 0 of a system means every port where that system was heard."""
    r = router("gcs", "autopilot", "camera", "other")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(1, 100), "camera", 0.0)
    assert r.route(frame(255, 190, to=(1, 0)), "gcs", 0.0) == ("autopilot", "camera")


def test_silent_component_is_looked_for_at_its_system() -> None:
    """A component that was not heard is reached where its system was."""
    r = router("gcs", "autopilot", "other")
    r.route(frame(1, 1), "autopilot", 0.0)
    assert r.route(frame(255, 190, to=(1, 154)), "gcs", 0.0) == ("autopilot",)


def test_sender_without_a_component_id_teaches_its_system_only() -> None:
    """Component 0 is not an address of its own: a frame to it is a frame to the whole system."""
    r = router("gcs", "a", "b")
    r.route(frame(1, 0), "a", 0.0)
    r.route(frame(1, 1), "b", 0.0)
    assert r.route(frame(255, 190, to=(1, 0)), "gcs", 0.0) == ("a", "b")


def test_unknown_target_is_looked_for_everywhere() -> None:
    """A frame for a system that was not heard goes to all other ports, until that system is heard."""
    r = router("gcs", "autopilot", peers=("p", "q"), floods_unknown=True)
    assert r.route(frame(255, 190, to=(9, 1)), "gcs", 0.0) == ("autopilot", "p", "q")
    assert r.route(frame(255, 190, to=(9, 1)), "p", 0.0) == ("gcs", "autopilot")
    r.route(frame(9, 1), "q", 1.0)
    assert r.route(frame(255, 190, to=(9, 1)), "gcs", 1.0) == ("q",)


def test_mirrored_conversation_passes_whole() -> None:
    """A port that carries both sides of a conversation is forwarded as it is, targeted frames too."""
    r = router("mirror", peers=("p",), floods_unknown=True)
    r.route(frame(1, 1), "mirror", 0.0)
    assert r.route(frame(255, 190, to=(1, 1)), "mirror", 0.0) == ("p",)
    assert r.route(frame(1, 1, to=(255, 190)), "mirror", 0.0) == ("p",)


def test_unknown_target_goes_nowhere() -> None:
    """Where nothing is flooded, a system that was not heard gets nothing, and that is counted."""
    r = router("gcs", "autopilot", peers=("p",))
    assert r.route(frame(255, 190, to=(9, 1)), "gcs", 0.0) == ()
    assert r.unrouted == {Unrouted.UNKNOWN_TARGET: 1}


def test_nothing_goes_back() -> None:
    """A frame between two components behind one port stays there."""
    r = router("serial", "gcs")
    r.route(frame(1, 1), "serial", 0.0)
    assert r.route(frame(1, 100, to=(1, 1)), "serial", 0.0) == ()
    assert r.unrouted == {Unrouted.NO_OTHER_PORT: 1}


def test_only_port_sends_to_nobody() -> None:
    """A broadcast with nobody to hear it is counted."""
    r = router("a")
    assert r.route(frame(), "a", 0.0) == ()
    assert r.unrouted == {Unrouted.NO_OTHER_PORT: 1}


def test_system_zero_is_not_learnt() -> None:
    """No sender is system 0; a frame from it is passed on and teaches nothing."""
    r = router("a", "b")
    assert r.route(frame(0, 0), "a", 0.0) == ("b",)
    assert r.addresses("a") == []
    r.route(frame(0, 0), "a", 1e6)


def test_claiming_a_systems_id_takes_nothing_from_it() -> None:
    """All ports where a system was heard get its frames: an impostor gains a copy, the real one loses nothing."""
    r = router("gcs", "autopilot", "impostor")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(1, 1), "impostor", 1.0)
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 2.0) == ("autopilot", "impostor")
    r.remove_port("impostor")
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 2.0) == ("autopilot",)


def test_peers_reach_local_ports_only() -> None:
    """What comes from a peer goes to no other peer, whether for all or for a system behind one."""
    r = router("autopilot", peers=("p", "q"))
    r.route(frame(2, 1), "q", 0.0)
    assert r.route(frame(3, 1), "p", 0.0) == ("autopilot",)
    assert r.route(frame(3, 1, to=(2, 1)), "p", 0.0) == ()


def test_relay_passes_between_peers() -> None:
    """A relay also joins its peers with each other."""
    r = router("autopilot", peers=("p", "q"), relays=True)
    r.route(frame(2, 1), "q", 0.0)
    assert r.route(frame(3, 1), "p", 0.0) == ("autopilot", "q")
    assert r.route(frame(3, 1, to=(2, 1)), "p", 0.0) == ("q",)


def test_frame_that_comes_by_two_ways_passes_once() -> None:
    """The second copy of a frame, from another port, is a duplicate for as long as the window lasts."""
    r = router("autopilot", peers=("lte", "radio"), duplicate_window_s=1.0)
    copy = b"same"
    assert r.route(frame(raw=copy), "lte", 10.0) == ("autopilot",)
    assert r.route(frame(raw=copy), "radio", 10.0) == ()
    assert r.route(frame(raw=copy), "radio", 10.999) == ()
    assert r.route(frame(raw=copy), "radio", 11.999) == ()
    assert r.unrouted == {Unrouted.DUPLICATE: 3}
    assert r.route(frame(raw=copy), "radio", 12.0) == ("autopilot",)


def test_senders_own_repetition_passes() -> None:
    """The same bytes from the same port are no duplicate, and their copies by the other way still are."""
    r = router("autopilot", peers=("lte", "radio"), duplicate_window_s=1.0)
    copy = b"same"
    for now in (0.0, 0.0, 0.5, 1.0, 1.9, 2.5):
        assert r.route(frame(raw=copy), "lte", now) == ("autopilot",)
        assert r.route(frame(raw=copy), "radio", now) == ()


def test_duplicate_teaches_nothing() -> None:
    """Where a frame came back round a loop, its sender does not live."""
    r = router("autopilot", "loop", "gcs")
    r.route(frame(1, 1, raw=b"x"), "autopilot", 0.0)
    r.route(frame(1, 1, raw=b"x"), "loop", 0.1)
    assert r.addresses("loop") == []


def test_route_ages_out() -> None:
    """A system that has been silent for the lifetime is unknown again, and not before."""
    r = router("gcs", "autopilot", route_lifetime_s=80.0)
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(1, 100), "autopilot", 40.0)
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 79.0) == ("autopilot",)
    r.route(frame(255, 190), "gcs", 95.0)
    assert r.addresses("autopilot") == [(1, 100)]
    r.route(frame(255, 190), "gcs", 131.0)
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 131.0) == ()


def test_systems_that_keep_talking_stay() -> None:
    """Each frame renews its sender's route."""
    r = router("gcs", "autopilot", route_lifetime_s=10.0)
    for second in range(0, 100, 5):
        r.route(frame(1, 1), "autopilot", float(second))
        assert r.route(frame(255, 190, to=(1, 1)), "gcs", float(second)) == ("autopilot",)


def test_removed_port_is_forgotten() -> None:
    """A port that is gone gets nothing, and neither does who was behind it."""
    r = router("gcs", "autopilot", "other")
    r.route(frame(1, 1), "autopilot", 0.0)
    r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0)
    r.remove_port("autopilot")
    r.remove_port("autopilot")
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0) == ()
    assert r.route(frame(255, 190), "gcs", 0.0) == ("other",)
    with pytest.raises(KeyError):
        r.route(frame(), "autopilot", 0.0)


def test_new_port_is_served_at_once() -> None:
    """Remembered decisions do not hide a port that was added, or a system that was heard, after them."""
    r = router("a", "b")
    assert r.route(frame(5, 1), "a", 0.0) == ("b",)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ()
    r.add_port("c")
    assert r.route(frame(5, 1), "a", 0.0) == ("b", "c")
    r.route(frame(6, 1), "c", 0.0)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ("c",)
    r.add_port("c", is_peer=True)
    r.add_port("a", is_peer=True)
    assert r.route(frame(5, 1, to=(6, 1)), "a", 0.0) == ()


def test_invented_addresses_crowd_out_only_their_own_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded per port: who makes up systems forgets its own, and nobody else's."""
    monkeypatch.setattr(routing, "MAX_ADDRESSES_PER_PORT", 8)
    r = router("gcs", "autopilot", "hostile")
    r.route(frame(1, 1), "autopilot", 0.0)
    for system in range(2, 250):
        r.route(frame(system, 1), "hostile", 0.0)
    assert len(r.addresses("hostile")) == 8
    assert r.route(frame(255, 190, to=(1, 1)), "gcs", 0.0) == ("autopilot",)
    assert r.route(frame(255, 190, to=(2, 1)), "gcs", 0.0) == ()
    assert r.route(frame(255, 190, to=(249, 1)), "gcs", 0.0) == ("hostile",)


def test_memory_of_frames_and_decisions_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of different frames and targets shortens the window; it does not grow the tables."""
    monkeypatch.setattr(routing, "MAX_FRAMES_REMEMBERED", 16)
    monkeypatch.setattr(routing, "MAX_DECISIONS", 8)
    r = router("a", "b")
    for i in range(500):
        r.route(frame(1, 1, to=(i % 255 + 1, i % 7)), "a", 0.0)
        assert len(r._seen) <= 16
        assert len(r._seen_before) <= 16
        assert len(r._decisions) <= 8
    assert r.route(frame(raw=b"late"), "a", 0.0) == ("b",)
    assert r.route(frame(raw=b"late"), "b", 0.0) == ()


@pytest.mark.parametrize("relays", [False, True])
def test_mesh_of_daemons_delivers_each_frame_once(relays: bool) -> None:
    """In a full mesh of four daemons every other autopilot gets a broadcast once, and nothing runs in circles."""
    nodes = ("d0", "d1", "d2", "d3")
    routers = {n: router("local", peers=tuple(p for p in nodes if p != n), relays=relays) for n in nodes}
    for turn, origin in enumerate(nodes * 3):
        sent = frame(turn + 1, 1)
        delivered = dict.fromkeys(nodes, 0)
        waiting = [(origin, "local")]
        hops = 0
        while waiting:
            hops += 1
            assert hops < 50
            node, source = waiting.pop(0)
            for port in routers[node].route(sent, source, float(turn)):
                if port == "local":
                    delivered[node] += 1
                else:
                    waiting.append((str(port), node))
        assert delivered == {n: int(n != origin) for n in nodes}


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b", "p", "q"]),
            st.tuples(st.integers(1, 3), st.integers(1, 2)),
            st.tuples(st.integers(0, 4), st.integers(0, 3)),
            st.integers(0, 30),
            st.floats(0, 4),
        ),
        max_size=60,
    ),
    st.booleans(),
)
@settings(max_examples=300, deadline=None)
def test_router_does_what_the_rules_say(
    steps: list[tuple[str, tuple[int, int], tuple[int, int], int, float]], relays: bool
) -> None:
    """Against a model that keeps everything it ever heard and reads the rules off it."""
    r = router("a", "b", peers=("p", "q"), relays=relays, route_lifetime_s=1e9, duplicate_window_s=1e9)
    heard: set[tuple[str, tuple[int, int]]] = set()
    first: dict[bytes, str] = {}
    now = 0.0
    for source, sender, to, content, pause in steps:
        now += pause
        raw = b"%r" % ((sender, to, content),)
        got = r.route(frame(*sender, to=to, raw=raw), source, now)
        if first.setdefault(raw, source) != source:
            assert got == ()
            continue
        heard.add((source, sender))
        others = [p for p in "abpq" if p != source and (relays or not (p in "pq" and source in "pq"))]
        at_component = {p for p, address in heard if address == to}
        at_system = {p for p, address in heard if address[0] == to[0]}
        wanted = set("abpq") if to[0] == 0 else at_component or at_system
        assert got == tuple(p for p in others if p in wanted)
