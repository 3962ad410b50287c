"""A peer as the shell sees it: what its budget is charged for."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.io.clients import PASSES
from tests.policies import TRUSTED
from tests.processes import frames
from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    PLAIN,
    QUIET,
    Pair,
    Side,
    exchange,
    of,
    payloads,
    quiet,
)
from tests.samples import attitude
from uavlinkd.config.build import verify_interval_s
from uavlinkd.config.model import PeerAddress
from uavlinkd.config.model import PeerConfig as Peer
from uavlinkd.daemon.peer_link import Carriage, PeerLink, Rates, radio_figures
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.own_frames import LinkFigures
from uavlinkd.protocol import handshake
from uavlinkd.protocol.constants import KNOWN_FEATURES, NEVER
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.outputs import Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.timers import Schedule
from uavlinkd.system.addresses import IPV4_UDP_BYTES, Address

BUDGET_BITS_S = 4000
REPLAYS_PER_S = 4
SECONDS = 60


def recorded_initiation(entropy: random.Random) -> bytes:
    """An initiation of alpha's that bravo never received."""
    made = handshake.initiate(KEY_A, PeerSettings("bravo", KEY_B.public, None, PLAIN), 77, 0, entropy.randbytes)
    return MacKeys(KEY_B.public).add_macs(made.message, None)


def link_of(side: Side, config: Peer, perform: Callable[[list[Output]], None]) -> PeerLink:
    """The link to the peer that this side's node has already."""
    return PeerLink(config, side.peer, Carriage(side.node, perform), 0.0)


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
    peer_link = link_of(pair.b, config, outputs.extend)
    peer_link.follow_paths(0.0)
    peer_link.send_waiting(0.0)  # the budget pays for the handshake, and for the question along the new path
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
    peer_link = link_of(pair.b, config, outputs.extend)
    while pair.b.peer.paths.totals.bytes_sent < 1_000_000:
        peer_link.send(heartbeat() * 20, PASSES, 1.0, 0.0)
    peer_link.change(replace(config, egress=EgressSettings(budget_bits_s=BUDGET_BITS_S)), 2.0)
    outputs.clear()
    peer_link.send(heartbeat(), PASSES, 2.0, 0.0)
    assert len(of(outputs, Transmit)) == 1


def test_a_peer_whose_addresses_are_other_ones_is_not_called_at_those_before() -> None:
    """Its new names may have no address yet. The path that is in use goes on being so."""
    pair = Pair(link_a=Link(suites=PLAIN.suites, timers=QUIET), link_b=PLAIN).establish()
    config = Peer(
        PeerSettings("bravo", KEY_B.public, None, PLAIN), (PeerAddress(Address("192.0.2.2", 14600)),), TRUSTED
    )
    link = link_of(pair.a, config, lambda _: None)
    assert list(pair.a.peer.paths.configured) == [AT_B]
    link.change(replace(config, egress=EgressSettings(coalesce_s=0.01)), 1.0)
    assert list(pair.a.peer.paths.configured) == [AT_B]
    link.change(replace(config, addresses=(PeerAddress(Address("new.test", 14600)),)), 2.0)
    assert list(pair.a.peer.paths.configured) == []
    assert pair.a.peer.path == AT_B


def measured(config: Peer, figures: LinkFigures) -> PeerLink:
    """A link that measured this."""
    link = link_of(Pair().a, config, lambda _: None)
    link.figures = figures
    return link


def test_an_autopilot_slows_down_for_operators_not_for_neighbours() -> None:
    """The worst link to an operator counts; that to a neighbour counts only without roles."""
    good, bad, worse = (LinkFigures(True, loss, loss, 0.1) for loss in (0.0, 0.1, 0.4))
    role = {"system_ids": [2], "role": "swarm-member"}
    neighbour = measured(Peer(PeerSettings("n", KEY_A.public), (), policy=role), worse)
    operators = [
        measured(Peer(PeerSettings("o", KEY_A.public), (), policy={**role, "role": "operator"}), figures)
        for figures in (good, bad)
    ]
    assert radio_figures([neighbour, *operators]) == bad
    assert radio_figures([neighbour, operators[0]]) == good
    assert radio_figures([neighbour]) == worse
    assert radio_figures([]) is None


def test_only_links_with_waiting_frames_are_scheduled() -> None:
    """Of two links the one whose frames wait is due, at its time; afterwards none is, and a removed link never."""
    schedule = Schedule[PeerLink]()
    link = Link(suites=PLAIN.suites, timers=QUIET)
    pair = Pair(link_a=link, link_b=link).establish()
    config = Peer(
        PeerSettings("alpha", KEY_A.public, None, link), (), TRUSTED, egress=EgressSettings(coalesce_s=0.01)
    )
    carriage = Carriage(pair.b.node, lambda _: None, waiting=schedule)
    links = [PeerLink(config, pair.b.peer, carriage, 0.0) for _ in range(2)]
    for member in links:
        member.follow_paths(0.0)
    assert schedule.next_at == NEVER

    links[0].send([attitude(1)], PASSES, 1.0, 0.0)
    assert schedule.next_at == 1.01
    assert schedule.pop(1.01) == [links[0]]
    links[0].send_waiting(1.01)
    assert schedule.next_at == NEVER

    links[0].send([attitude(2)], PASSES, 2.0, 0.0)
    links[0].leave(2.0)
    assert schedule.next_at == NEVER


# Reports of what the policy refuses.

ARM = 400
QUIET_LINK = Link(suites=PLAIN.suites, timers=QUIET)


def member_of(pair: Pair, sent: list[Output], budget_bits_s: int = 0) -> PeerLink:
    """Bravo's link to a swarm member."""
    rules = {"role": "swarm-member", "system_ids": [1, 255]}
    settings = PeerSettings("alpha", KEY_A.public, None, QUIET_LINK)
    return link_of(pair.b, Peer(settings, (), rules, EgressSettings(budget_bits_s=budget_bits_s)), sent.extend)


def refuse(link: PeerLink, *raws: bytes) -> None:
    """Let the policy judge frames of the peer."""
    for frame in split_payload(b"".join(raws), SplitCounters()):
        link.policy.incoming.check(frame, 0.0)


@pytest.mark.parametrize("budget", [0, 4000])
def test_reports_leave_room_for_frames(budget: int) -> None:
    """On a link with a budget, a report is sent while no frame waits and the budget covers it, and it is charged."""
    pair, sent = Pair().establish(), list[Output]()
    link = member_of(pair, sent, budget)
    link.follow_paths(0.0)
    link.report_refusals(1.0)
    waiting = split_payload(b"".join(frames.heartbeat(1, seq=number) for number in range(50)), SplitCounters())
    link.send(waiting, PASSES, 1.0, 0.0)
    refuse(link, frames.command_long(ARM, 255))
    sent.clear()
    link.report_refusals(1.0)
    assert len(of(sent, Transmit)) == (0 if budget else 1)
    if budget and link.pacer.egress is not None:
        link.pacer.egress.clear()
        before = link.pacer.demand(30.0)
        link.report_refusals(30.0)
        assert len(of(sent, Transmit)) == 1
        assert link.pacer.demand(30.0) > before


def test_problem_reports_use_little_of_a_slow_link() -> None:
    """Problems that come and go each second: at 4 kbit/s their reports use less than a tenth, and frames go first."""
    pair, sent = Pair(quiet(features=KNOWN_FEATURES), quiet(features=KNOWN_FEATURES)).establish(), list[Output]()
    link = member_of(pair, sent, BUDGET_BITS_S)
    link.follow_paths(0.0)
    for second in range(1, SECONDS + 1):
        link.report_problems([second % 2 + 1], float(second))
    reports = of(sent, Transmit)
    assert SECONDS / 4 < len(reports) <= SECONDS / 2
    assert 8 * sum(len(report.datagram) + IPV4_UDP_BYTES for report in reports) < BUDGET_BITS_S * SECONDS / 10
    waiting = split_payload(b"".join(frames.heartbeat(1, seq=number) for number in range(250)), SplitCounters())
    link.send(waiting, PASSES, SECONDS + 2.0, 0.0)
    sent.clear()
    link.report_problems([9], SECONDS + 2.0)
    assert of(sent, Transmit) == []


# The figures of a link with several paths.

ROUND_TRIP_S = 0.05


def flown(seconds: float, lost_each: int = 0) -> tuple[Pair, PeerLink]:
    """Alpha has a path that works and a dead one. Each ``lost_each``-th datagram to bravo is lost after a second."""
    pair = Pair(quiet(), quiet())
    config = Peer(
        PeerSettings("bravo", KEY_B.public, None, PLAIN), (PeerAddress(Address("192.0.2.2", 14600)),), TRUSTED
    )
    link = link_of(pair.a, config, lambda _: None)
    pair.a.node.set_paths(pair.a.peer, [AT_B, ELSEWHERE], 0.0)
    flight: list[tuple[float, bool, bytes]] = []  # when it arrives, whether at bravo
    sent = 0
    for step in range(round(seconds * 40)):
        now = step / 40
        arriving = [entry for entry in flight if entry[0] <= now]
        flight = [entry for entry in flight if entry[0] > now]
        outputs = [(pair.a, pair.a.timeout(now)), (pair.b, pair.b.timeout(now))]
        for _, is_to_b, datagram in arriving:
            side = pair.b if is_to_b else pair.a
            outputs.append((side, side.receive(datagram, now)))
        if pair.a.peer.is_up and step % 2:
            outputs.append((pair.a, pair.a.send(now)))
        for side, out in ((side, out) for side, outs in outputs for out in of(outs, Transmit)):
            if out.path == AT_B or side is pair.b:
                sent += side is pair.a
                if not (lost_each and side is pair.a and now > 1.0 and sent % lost_each == 0):
                    flight.append((now + ROUND_TRIP_S / 2, side is pair.a, out.datagram))
        if step % 40 == 0:
            link.measure(now)
    return pair, link


def test_figures_of_a_link_with_several_paths_are_those_of_the_path_in_use() -> None:
    """Probes along the dead path are lost, and RADIO_STATUS does not show it; a lossy path in use shows."""
    _, clean = flown(30.0)
    assert (clean.figures.loss_in, clean.figures.loss_out) == (0, 0)
    assert clean.figures.round_trip_s == pytest.approx(ROUND_TRIP_S, abs=0.03)
    _, lossy = flown(30.0, lost_each=4)
    assert lossy.figures.loss_out == pytest.approx(0.25, abs=0.1)


def test_probes_on_a_dead_path_are_not_in_the_figures_of_the_receiver() -> None:
    """It knows one path only, along which the other end reports."""
    pair, _ = flown(30.0)
    assert pair.b.session.missing(30.0) > 10
    assert pair.b.peer.missing(30.0) == 0


def test_rates_of_paths_that_come_and_go() -> None:
    """A new path has none, one that is gone is forgotten, and a clock that stands still divides nothing by zero."""
    pair = Pair().establish()
    (state,) = pair.a.peer.paths.states
    rates = Rates(0.0)
    rates.measure(pair.a.peer, 1.0)
    assert rates.of(state) == (0.0, 0.0)
    state.bytes_received += 100
    state.bytes_sent += 50
    rates.measure(pair.a.peer, 1.0)
    rates.measure(pair.a.peer, 3.0)
    assert rates.of(state) == (50.0, 25.0)
    rates.measure(pair.b.peer, 4.0)
    assert rates.of(state) == (0.0, 0.0)
