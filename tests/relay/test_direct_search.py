"""The search for direct paths: which candidates are asked, when, and what two ends reach with it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from structlog import get_logger

from tests.protocol.harness import Pair, Side, of, quiet
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Output, PathStateChanged, RecordReceived, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import Candidates
from uavlinkd.relay import clients
from uavlinkd.relay.clients import Relays
from uavlinkd.relay.direct_search import (
    LISTS,
    LISTS_PER_S,
    DirectSearch,
    OwnSocket,
    Place,
    is_private,
    may_be_asked,
    paths_to,
    places_of,
)

LINK = quiet(features=c.FEATURE_RECORDS)
HOME_A, HOME_B = ("198.51.100.1", 4001), ("203.0.113.2", 4002)
SYMMETRIC_A = ("198.51.100.1", 40_000)
"""Where a symmetric NAT shows alpha to bravo. The relay sees it at HOME_A."""


def leads_to_mesh(host: str) -> bool:
    """The only private network of a socket."""
    return host.startswith("10.13.")


SOCKET = OwnSocket(0, False, (("10.13.0.5", 5790),), leads_to_mesh)
SOCKET_6 = OwnSocket(1, True, (("2001:db8::5", 5790),), leads_to_mesh)


def asked(*places: Place) -> list[Path]:
    """The paths to these candidates from both sockets."""
    return list(paths_to(places, [SOCKET, SOCKET_6], {("192.0.2.1", 5790)}, {"10.13.0.5", "2001:db8::5"}))


# Which candidates are asked.


SPECIAL = """
127.0.0.1 ::1 0.0.0.0 :: 224.0.0.1 ff02::1 255.255.255.255 240.0.0.1 fe80::1 0.1.2.3 fec0::1 ::127.0.0.1
::ffff:192.0.2.1 64:ff9b::7f00:1 2002:7f00:1::1 2001:0:7f00:1::1 4000::1
"""


@pytest.mark.parametrize(
    "place", [*((host, 5790) for host in SPECIAL.split()), ("203.0.113.1", 53), ("203.0.113.1", 0)]
)
def test_special_addresses_and_low_ports_are_never_asked(place: Place) -> None:
    """A captured member must not make others ask servers, groups or themselves."""
    assert not may_be_asked(place)
    assert asked(place) == []


def test_relays_and_this_machine_are_not_asked() -> None:
    """Relays are known already. Another service of this machine is not the peer's business, on whichever port."""
    assert asked(("192.0.2.1", 5790), ("10.13.0.5", 5790), ("10.13.0.5", 14550), ("2001:db8::5", 5790)) == []


@pytest.mark.parametrize(
    ("host", "expected"), [("10.13.0.9", True), ("10.14.0.9", False), ("192.168.1.1", False), ("100.64.0.1", False)]
)
def test_private_addresses_need_a_route(host: str, expected: bool) -> None:
    """The same address is another machine elsewhere: the default route does not lead to the peer."""
    assert is_private(host)
    assert bool(asked((host, 5790))) is expected


def test_hosts_and_candidates_are_limited() -> None:
    """Two ports for each host, eight paths in all."""
    ports = [("203.0.113.1", 4000 + number) for number in range(5)]
    assert len(asked(*ports)) == c.CANDIDATES_PER_HOST
    assert len(asked(*(("203.0.113.1", 4000), *((f"203.0.113.{number}", 4000) for number in range(2, 30))))) == 8


def test_own_candidates_begin_with_what_relays_see() -> None:
    """Behind NAT only that leads here. What the other end would refuse is not named."""
    places = places_of([HOME_A, HOME_A, ("127.0.0.1", 5790)], [SOCKET, SOCKET_6])
    assert places == (HOME_A, ("10.13.0.5", 5790), ("2001:db8::5", 5790))
    many = [(f"203.0.113.{number}", 4000) for number in range(20)]
    assert places_of(many, [SOCKET]) == tuple(many[: c.CANDIDATES])


# When.


class Network:
    """Two members behind NATs that filter by address and port, and a relay. A hole opens with a datagram to there."""

    def __init__(self, *, hard: bool = False) -> None:
        self.pair = Pair(LINK, LINK)
        self.pair.a.peer_at, self.pair.b.peer_at = relayed(0, "vps", 7), relayed(0, "vps", 8)
        for side in (self.pair.a, self.pair.b):
            side.configure_path(0.0)
        self.pair.complete(self.pair.initiation(0.0), 0.0)  # no datagram is lost
        assert self.pair.carries(0.0)
        self.hard = hard
        """Alpha's NAT is symmetric, and bravo's filters by port."""
        self.open: set[tuple[str, Place]] = set()
        self.search = {"a": DirectSearch(self.pair.a.node, self.pair.a.peer, 0.0)}
        self.search["b"] = DirectSearch(self.pair.b.node, self.pair.b.peer, 0.0)
        self.questions = 0
        self.loses = 0
        """Of the frames that :meth:`talk` sends, the relay loses one in so many; 0 for none."""
        self.lost = {"a": 0, "b": 0}
        """Of the frames of each end."""
        self._frames = 0

    def set_own(self, now: float) -> None:
        """Both ends know how the relay sees them."""
        for name, home in (("a", HOME_A), ("b", HOME_B)):
            self.search[name].set_own((home,), [OwnSocket(0, False, (), leads_to_mesh)], (), now)

    def play(self, until: float, start: float = 0.0) -> None:
        """Let both search, and pass what goes along the relay or through an open NAT."""
        now = start
        while now < until:
            for name, side in (("a", self.pair.a), ("b", self.pair.b)):
                outputs = side.timeout(now)
                if now >= self.search[name].next_at:
                    outputs += self.search[name].do_due(now)
                self._perform(name, outputs, now)
            now += 0.05

    def talk(self, until: float, start: float = 0.0) -> None:
        """Search, while each end sends a heartbeat a second, and counts what is missing."""
        for second in range(int(start), int(until)):
            self.play(second + 1.0, start=float(second))
            for name in "ab":
                now, side = second + 1.0, self._side(name)
                frame = side.send(now)
                self._frames += 1
                if self.loses and not self._frames % self.loses:
                    self.lost[name] += 1
                else:
                    self._perform(name, frame, now)
                side.peer.missing(now)

    def _perform(self, name: str, outputs: list[Output], now: float) -> None:
        other, side = ("b", self.pair.b) if name == "a" else ("a", self.pair.a)
        for output in outputs:
            if isinstance(output, Transmit):
                at = self._arrives(name, output.path)
                if at is not None:
                    self._perform(other, side.node.receive(output.datagram, at, now + 0.01), now + 0.01)
            elif isinstance(output, RecordReceived):
                self.search[name].on_record(output, now)
            elif isinstance(output, PathStateChanged | SessionEstablished):
                self.search[name].on_event(output, now)

    def _arrives(self, name: str, path: Path) -> Path | None:
        """The path by which a datagram comes to the other end; None if it does not."""
        source, target = (HOME_A, HOME_B) if name == "a" else (HOME_B, HOME_A)
        if path.is_relayed:
            return self._side("b" if name == "a" else "a").peer_at
        self.questions += 1
        if self.hard:
            source, target = (SYMMETRIC_A, HOME_B) if name == "a" else (HOME_B, SYMMETRIC_A)
        self.open.add((name, (path.address[0], path.address[1])))
        is_there = path.address == target
        return Path(0, source) if is_there and ("b" if name == "a" else "a", source) in self.open else None

    def _side(self, name: str) -> Side:
        return self.pair.a if name == "a" else self.pair.b


@pytest.mark.parametrize("loses", [0, 7])
def test_impossible_pair_stays_on_the_relay_and_asks_less_and_less(loses: int) -> None:
    """A symmetric NAT and one that filters by port. Questions in vain leave gaps in the counters: no loss.

    Each frame that the relay loses counts, and nothing else.
    """
    network = Network(hard=True)
    network.loses = loses
    network.set_own(0.1)
    network.talk(100.0)  # before the next session, with which the tries begin again
    assert network.pair.a.peer.path == network.pair.a.peer_at
    assert 2 * c.CANDIDATE_TRIES <= network.questions <= 2 * (c.CANDIDATE_TRIES + 7)
    network.loses, lost = 0, network.lost
    network.talk(200.0, start=100.0)
    assert network.questions > 4 * c.CANDIDATE_TRIES
    assert network.pair.b.peer.missing(200.0) == lost["a"] >= 2 * loses
    assert network.pair.a.peer.missing(200.0) == lost["b"] >= 2 * loses


def test_older_list_is_dropped() -> None:
    """Records may overtake each other along two paths."""
    network = Network()
    peer, path = network.pair.a.peer, network.pair.a.peer_at
    search = network.search["a"]
    search.on_record(RecordReceived(peer, path, Candidates((HOME_B,)), 5), 1.0)
    assert search.on_record(RecordReceived(peer, path, Candidates((HOME_A,)), 4), 1.0) is DropReason.OLD_RECORD
    assert search.theirs == (HOME_B,)
    assert search.next_at == 1.0
    search.do_due(1.0)
    assert search.on_record(RecordReceived(peer, path, Candidates((HOME_B,)), 6), 1.05) is None
    assert search.next_at == pytest.approx(1.0 + c.CANDIDATE_TRY_S)


@pytest.mark.parametrize(
    ("is_relayed", "is_usable", "begins"),
    [(True, True, True), (False, False, True), (False, True, False), (True, False, False)],
)
def test_search_begins_again_when_it_may_help(is_relayed: bool, is_usable: bool, begins: bool) -> None:
    """A relayed path works, or a direct one failed."""
    network = Network()
    path = network.pair.a.peer_at if is_relayed else Path(0, HOME_B)
    network.search["a"].on_event(PathStateChanged(network.pair.a.peer, path, is_usable, "answered"), 3.0)
    assert (network.search["a"].next_at == 3.0) is begins


def test_relay_that_ends_handles_renews_no_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends the handles and assigns them again ten times a second. The lists are limited, and keep their order."""
    network = Network()
    peer, path = network.pair.a.peer, network.pair.a.peer_at
    link = SimpleNamespace(peer=peer, relayed=[path])
    links: dict[str, Any] = {"bravo": link}
    relays = Relays(network.pair.a.node, Mock(), Mock(spec=PeerSockets), links, {}, get_logger())
    own = [OwnSocket(0, is_ipv6=True, places=(HOME_A,), leads_to=bool)]
    monkeypatch.setattr(clients, "own_sockets", lambda _: own)
    relays.do_housekeeping(0.0)
    assert relays.on_record(RecordReceived(peer, path, Candidates((HOME_B,)), 5), 0.0) is None
    lists = 0
    for round_ in range(200):
        now = 0.1 + round_ / 10
        for link.relayed in ([], [path]):
            relays.do_housekeeping(now)
        relays.on_event(PathStateChanged(peer, path, True, "answered"), now)
        outputs = relays._searches[peer].do_due(now)
        lists += sum(transmit.path.is_relayed for transmit in of(outputs, Transmit))
    assert LISTS <= lists <= LISTS + 20 * LISTS_PER_S + 1
    older = RecordReceived(peer, path, Candidates((HOME_A,)), 4)
    assert relays.on_record(older, now) is DropReason.OLD_RECORD
    links.clear()
    relays.do_housekeeping(now)
    assert relays.on_record(older, now) is DropReason.UNEXPECTED_RECORD
