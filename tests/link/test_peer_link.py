"""A peer as the shell sees it: what its budget is charged for."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.core.harness import AT_A, AT_B, ELSEWHERE, KEY_A, KEY_B, PLAIN, QUIET, Pair, exchange, of, payloads
from tests.endpoints.clients import PASSES
from tests.policies import TRUSTED
from uavlinkd.system.addresses import Address
from uavlinkd.config import Peer
from uavlinkd.config.pace import verify_interval_s
from uavlinkd.core import handshake
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.outputs import Output, Path, Transmit
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.radio_status import LinkFigures
from uavlinkd.link.peer_link import PeerLink, radio_figures
from uavlinkd.link.status import peer_status

BUDGET_BITS_S = 4000
REPLAYS_PER_S = 4
SECONDS = 60


def recorded_initiation(entropy: random.Random) -> bytes:
    """An initiation of alpha's that bravo never heard."""
    made = handshake.initiate(KEY_A, PeerSettings("bravo", KEY_B.public, None, PLAIN), 77, 0, entropy.randbytes)
    return MacKeys(KEY_B.public).add_macs(made.message, None)


def heartbeat() -> list[Frame]:
    """A vehicle's."""
    raw = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(mavlink.MAVLink(None)))
    return split_payload(raw, SplitCounters())


@pytest.mark.parametrize("source", [ELSEWHERE, AT_A], ids=["from elsewhere", "in the peer's name"])
def test_replayed_handshakes_do_not_silence_a_link_with_a_budget(source: Path) -> None:
    """With 4 kbit/s, and four of the peer's recorded initiations answered or not each second, heartbeats pass."""
    interval_s = verify_interval_s(BUDGET_BITS_S, PLAIN.tag_bytes)
    link = Link(suites=PLAIN.suites, timers=QUIET, verify_interval_s=interval_s)
    pair = Pair(link_a=link, link_b=link).establish()
    outputs: list[Output] = []
    config = Peer(
        PeerSettings("alpha", KEY_A.public, None, link),
        (),
        TRUSTED,
        egress=EgressSettings(budget_bits_s=BUDGET_BITS_S),
    )
    peer_link = PeerLink(config, pair.b.node, outputs.extend, 0.0)
    peer_link.on_session()
    heartbeats = heartbeat()
    entropy, arrived = random.Random(7), 0

    for tick in range(SECONDS * REPLAYS_PER_S):
        now = 1.0 + tick / REPLAYS_PER_S
        pair.b.receive(recorded_initiation(entropy), now, source)
        if tick % REPLAYS_PER_S == 0:
            peer_link.send(heartbeats, PASSES, now, 0.0)
        peer_link.send_waiting(now)
        assert all(sent.path == AT_A for sent in of(outputs, Transmit))
        arrived += len(payloads(exchange(pair.a, pair.b, outputs, now)))
        outputs.clear()

    assert arrived >= SECONDS - (1 if source == ELSEWHERE else 2)  # those of the first burst go at once


def test_a_budget_that_comes_with_a_reload_pays_for_nothing_before_it() -> None:
    """A megabyte was sent without any: the first heartbeat under 4 kbit/s goes at once, in envelopes as before."""
    link = Link(suites=PLAIN.suites, timers=QUIET)
    pair = Pair(link_a=link, link_b=link).establish()
    outputs: list[Output] = []
    config = Peer(PeerSettings("alpha", KEY_A.public, None, link), (), TRUSTED)
    peer_link = PeerLink(config, pair.b.node, outputs.extend, 0.0)
    while pair.b.peer.traffic.bytes_sent < 1_000_000:
        peer_link.send(heartbeat() * 20, PASSES, 1.0, 0.0)
    peer_link.change(replace(config, egress=EgressSettings(budget_bits_s=BUDGET_BITS_S)), 2.0)
    outputs.clear()
    peer_link.send(heartbeat(), PASSES, 2.0, 0.0)
    assert len(of(outputs, Transmit)) == 1
    assert peer_link.egress is not None
    assert peer_link.egress.shape.payload_limit == pair.b.session.payload_limit


def test_new_budget_changes_the_interval_of_the_next_session() -> None:
    """The session in use goes on with the one that it began with."""
    link = Link(suites=PLAIN.suites, timers=QUIET)
    pair = Pair(link_a=link, link_b=link).establish()
    config = Peer(PeerSettings("alpha", KEY_A.public, None, link), (), TRUSTED)
    peer_link = PeerLink(config, pair.b.node, lambda _: None, 0.0)
    slower = replace(config.settings, link=replace(link, verify_interval_s=5.0))
    peer_link.change(replace(config, settings=slower), 1.0)
    assert pair.b.peer.verify_interval_s == 5.0
    assert pair.b.peer.sessions.current is pair.b.session


@pytest.mark.parametrize(("since", "shown"), [(None, None), (10.0, 2.5)])
def test_status_has_the_time_of_unverified_freshness(since: float | None, shown: float | None) -> None:
    """In seconds until now; nothing while freshness is verified."""
    pair = Pair().establish()
    pair.b.peer._age.unverified_since = since
    peer_link = PeerLink(Peer(PeerSettings("alpha", KEY_A.public), (), TRUSTED), pair.b.node, lambda _: None, 0.0)
    assert peer_status(peer_link, 12.5)["freshness_unverified_s"] == shown


def test_a_peer_whose_addresses_are_other_ones_is_not_called_at_those_before() -> None:
    """Its new names may have no address yet. The path that is in use goes on being so."""
    pair = Pair(link_a=Link(suites=PLAIN.suites, timers=QUIET), link_b=PLAIN).establish()
    config = Peer(PeerSettings("bravo", KEY_B.public, None, PLAIN), (Address("192.0.2.2", 14600),), TRUSTED)
    link = PeerLink(config, pair.a.node, lambda _: None, 0.0)
    assert list(pair.a.peer.caller.addresses) == [AT_B]
    link.change(replace(config, egress=EgressSettings(coalesce_s=0.01)), 1.0)
    assert list(pair.a.peer.caller.addresses) == [AT_B]
    link.change(replace(config, addresses=(Address("new.test", 14600),)), 2.0)
    assert list(pair.a.peer.caller.addresses) == []
    assert pair.a.peer.path == AT_B


@pytest.mark.parametrize(("addresses", "told_at"), [((Address("192.0.2.2", 14600),), 5), ((), 30)])
def test_a_peer_that_is_not_heard_is_told_of_once(addresses: tuple[Address, ...], told_at: int) -> None:
    """Soon where it is called in vain, later where it has to call; and again only when it was up meanwhile."""
    pair = Pair(link_a=Link(suites=PLAIN.suites, timers=QUIET), link_b=PLAIN)
    config = Peer(PeerSettings("bravo", KEY_B.public, None, PLAIN), addresses, TRUSTED)
    link = PeerLink(config, pair.a.node, lambda _: None, 0.0)
    assert [second for second in range(200) if link.is_unheard(float(second))] == [told_at]
    link.change(replace(config, addresses=(Address("192.0.2.3", 14600),)), 200.0)  # told anew, of the new address
    assert [second for second in range(200, 300) if link.is_unheard(float(second))] == [205]
    link.set_paths([AT_B], 300.0)
    pair.establish(300.0)
    assert not link.is_unheard(300.0)


def measured(config: Peer, figures: LinkFigures) -> PeerLink:
    """A link that measured this."""
    link = PeerLink(config, Pair().a.node, lambda _: None, 0.0)
    link._figures = figures
    return link


def test_an_autopilot_slows_down_for_operators_not_for_neighbours() -> None:
    """The worst link to an operator is told; that to a neighbour only where no role says who operates."""
    good, bad, worse = (LinkFigures(True, loss, loss, 0.1) for loss in (0.0, 0.1, 0.4))
    role = {"system_ids": [2], "role": "swarm-member"}
    neighbour = measured(Peer(PeerSettings("n", KEY_A.public), (), policy=role), worse)
    operators = [
        measured(Peer(PeerSettings("o", KEY_A.public), (), policy={**role, "role": "operator"}), each)
        for each in (good, bad)
    ]
    assert radio_figures([neighbour, *operators]) == bad
    assert radio_figures([neighbour, operators[0]]) == good
    assert radio_figures([neighbour]) == worse
    assert radio_figures([]) is None
