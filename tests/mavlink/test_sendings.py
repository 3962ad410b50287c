"""Equal bytes: each sending is delivered once, whatever copies, bridges and echoes do with it."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from itertools import count
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.mavlink import sendings
from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.routing import Router, Unrouted
from uavlinkd.mavlink.sendings import REMEMBERED_S, ROUTES_DIFFER_S

HEARTBEAT, COMMAND = IDS["HEARTBEAT"], IDS["COMMAND_LONG"]
VEHICLE, STATION = (1, 1), (255, 190)


def beat(raw: bytes, system: int = 1) -> Frame:
    return Frame(raw, Header(HEARTBEAT, system, 1))


def command(raw: bytes = b"arm") -> Frame:
    return Frame(raw, Header(COMMAND, *STATION, *VEHICLE, command=400))


def router(*clients: str, peers: tuple[str, ...] = ("peer",)) -> Router[str]:
    """The endpoint of a client is its first letter."""
    made = Router[str]()
    for port in (*clients, *peers):
        made.add_port(port, is_peer=port in peers, endpoint=port[0])
    return made


@pytest.mark.parametrize("endpoints", ["gg", "gh"])
def test_every_command_of_every_client_passes(endpoints: str) -> None:
    """It repeats itself, another station has its id, another one replaces it: also at the same moment."""
    first, second = f"{endpoints[0]}1", f"{endpoints[1]}2"
    r = router(first, second)
    r.route(beat(b"v"), "peer", 0.0)
    for at in (0.0, 0.0, 0.3, 0.6, 3.0, 9.0):
        assert r.route(command(), first, at) == r.route(command(), second, at) == ("peer",)
    r.remove_port(first)
    r.add_port("g3", endpoint="g")
    assert r.route(command(), "g3", 9.1) == ("peer",)
    assert r.unrouted == {}


def test_copies_by_two_routes_pass_once_for_each_sending() -> None:
    """The n-th arrival by one route is the n-th by the other, also if the second sending overtakes a copy."""
    r = router("client", peers=("lte", "radio"))
    passed = [bool(r.route(command(), *arrival)) for arrival in (("lte", 0.0), ("lte", 0.1), ("radio", 0.3))]
    passed += [bool(r.route(command(), *arrival)) for arrival in (("radio", 0.4), ("radio", 0.5), ("lte", 0.9))]
    assert passed == [True, True, False, False, True, False]
    late = 0.5 + ROUTES_DIFFER_S
    assert r.route(command(), "lte", late) == ("client",)
    assert not r.route(command(), "radio", late + 0.99 * ROUTES_DIFFER_S)


def test_client_that_repeats_a_broadcast_loses_one() -> None:
    """Its first repetition looks like a return. The second one shows that none was one: all further ones pass."""
    r = router("a", "b")
    assert [bool(r.route(beat(b"x"), "a", float(at))) for at in range(8)] == [True, False, *[True] * 6]
    assert r.sendings.circles == {}
    passed = [bool(r.route(beat(b"y"), "a", 9 + at / 16)) for at in range(24)]
    assert sum(passed) == 12  # at 16 Hz every second one: those are REPEATED_S apart
    r = router("a")
    assert all(r.route(beat(b"x"), "a", at / 10) and r.route(beat(b"y", 9), "peer", at / 10) for at in range(8))


def test_busy_sender_repeats_its_sequence_numbers() -> None:
    """After 256 frames equal bytes are another frame, also within the memory."""
    r = router("a", "b")
    for number in range(3 * 256):
        assert r.route(beat(b"%d" % (number % 256)), "a", number / 256)


def test_own_frames_that_return_go_nowhere() -> None:
    """From the client that got them."""
    r = router("a", "b")
    r.sendings.note_own(b"text", ["a"], 0.0)
    assert r.route(beat(b"text"), "a", REMEMBERED_S) == ()
    assert r.unrouted == {Unrouted.DUPLICATE: 1}


def test_circle_has_the_systems_whose_frames_return() -> None:
    """All components of a vehicle are one system: a second one is the sign of a circle."""
    r = router("a", "b")
    for component in (1, 2, 3):
        frame = Frame(b"%d" % component, Header(HEARTBEAT, 7, component))
        assert r.route(frame, "a", component) == ("b", "peer")
        assert r.route(frame, "b", component + 0.1) == ()
    assert r.sendings.circles["b"].systems == {7}


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of different frames shortens it."""
    monkeypatch.setattr(sendings, "MAX_FRAMES_REMEMBERED", 16)
    r = router("a", "b")
    for i in range(500):
        r.route(beat(b"%d" % i), "a", 0.0)
        r.sendings.note_own(b"own %d" % i, ["a"], 20.0 * i)
        assert len(r.sendings.seen) + len(r.sendings.seen_before) <= 33


class Bridge(NamedTuple):
    """Something outside that sends what one port gets into another one; the same port: an echo."""

    out_of: str
    into: str
    delay_s: float


class World:
    """A router, clients, and what joins them outside, in virtual time."""

    def __init__(self, made: Router[str]) -> None:
        self.router = made
        self.bridges: list[Bridge] = []
        self.delivered = Counter[tuple[bytes, str]]()
        self.gone = set[str]()
        self.now = 0.0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = count()

    def at(self, when: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, (when, next(self._numbers), act))

    def send(self, frame: Frame, source: str) -> None:
        if source in self.gone:
            return
        for port in self.router.route(frame, source, self.now):
            self.delivered[frame.raw, port] += 1
            assert self.delivered[frame.raw, port] < 100, "a circle"
            for bridge in self.bridges:
                if bridge.out_of == port:
                    self.at(self.now + bridge.delay_s, lambda into=bridge.into: self.send(frame, into))  # type: ignore[misc]

    def run(self) -> None:
        while self._due:
            self.now, _, act = heapq.heappop(self._due)
            act()


PLACES = st.integers(0, 3)
DELAYS = st.floats(0.0001, 0.99 * REMEMBERED_S)
BRIDGES = st.lists(st.tuples(PLACES, PLACES, DELAYS), max_size=3, unique_by=lambda bridge: bridge[1])
KINDS = st.sampled_from(["broadcast", "by two routes", "command", "replace"])
ACTS = st.lists(st.tuples(KINDS, PLACES, st.floats(0, 2)), max_size=25)


@given(st.integers(2, 4), BRIDGES, ACTS, st.booleans())
@settings(max_examples=30, deadline=None)
def test_every_sending_is_delivered_once(
    clients: int, bridges: list[tuple[int, int, float]], acts: list[tuple[str, int, float]], is_local: bool
) -> None:
    """In spite of bridges and echoes: broadcasts and commands that differ, and equal commands of several clients.

    Two clients have one endpoint. At most one bridge leads to each client, and its commands differ then. First each
    sender announces itself, and the peer another system.
    """
    names = ["a0", "a1", "b2", "c3"][:clients]
    world = World(router(*names))
    world.bridges = [Bridge(names[i], names[j], delay) for i, j, delay in bridges if max(i, j) < clients]
    vehicle, numbers, wanted = names[0] if is_local else "peer", count(), Counter[tuple[bytes, str]]()

    def broadcast(source: str, system: int, copy_from: str = "") -> None:
        frame = beat(b"%d" % next(numbers), system)
        wanted.update((frame.raw, port) for port in (*names, "peer") if port != source)
        world.send(frame, source)
        if copy_from:
            world.at(world.now + 0.9 * ROUTES_DIFFER_S, lambda: world.send(frame, copy_from))

    def act(kind: str, place: int) -> None:
        name = names[place]
        if kind == "broadcast":
            broadcast(name, 10 + place)
        elif kind == "by two routes":
            broadcast(name, 10 + place, copy_from="peer")
        elif kind == "command" and name != vehicle:
            is_joined = any(name == bridge.into for bridge in world.bridges)
            order = command(b"arm %d" % next(numbers) if is_joined else b"arm")
            wanted[order.raw, vehicle] += 1
            world.send(order, name)
        elif kind == "replace" and name != vehicle:
            world.router.remove_port(name)
            world.gone.add(name)
            names[place] = f"{name[0]}{next(numbers)}"
            world.router.add_port(names[place], endpoint=name[0])

    broadcast(vehicle, VEHICLE[0])
    broadcast("peer", 9)
    for place in range(clients):
        broadcast(names[place], 10 + place)
    when = REMEMBERED_S
    for kind, place, pause in acts:
        when += pause
        if place < clients:
            world.at(when, lambda kind=kind, place=place: act(kind, place))  # type: ignore[misc]
    world.run()
    assert world.delivered == wanted
