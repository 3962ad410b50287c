"""Timers by network: handshakes, echoes and waits on networks with a budget. README.md, section 14."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.core.harness import Side
from tests.core.radios import Radios, link
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.outputs import FreshnessUnverified, PeerLost
from uavlinkd.core.path import SERIAL_HOST, Path
from uavlinkd.core.settings import Class
from uavlinkd.core.socket_facts import FREE, Pace, SocketFacts
from uavlinkd.core.suites import SUITES_BY_NAME, X25519
from uavlinkd.core.verification import Verification

LTE, SIK = 0, 1
BUDGET_BITS_S = 4_000
AIRTIME_S = 8 * (147 + 103 + 2 * 48) / BUDGET_BITS_S
"""Of an initiation and its response with `x25519`."""
ECHO_AIRTIME_S = 8 * (76 + 2 * 48) / BUDGET_BITS_S


def facts(budget_bits_s: float = BUDGET_BITS_S, peers: int = 1) -> SocketFacts:
    """One network with a budget."""
    made = SocketFacts()
    made.set_budgets({SIK: budget_bits_s})
    made.share_budgets(peers)
    return made


def slow(*delays_s: float, slow_sockets: tuple[int, ...] = (SIK,)) -> Radios:
    """Radios of which some have a budget at both ends."""
    radios = Radios(delays_s, link(), link(), both_configured=True)
    for side in (radios.a, radios.b):
        side.node.set_budgets(dict.fromkeys(slow_sockets, BUDGET_BITS_S))
    return radios


def times(radios: Radios, side: Side, radio: int, kind: int, since: float = 0.0) -> list[float]:
    """When a side sent messages of this kind along a radio."""
    return [
        one.at
        for one in radios.sent
        if one.side is side and one.path.socket == radio and one.datagram[0] == kind and one.at >= since
    ]


def echoes(radios: Radios, side: Side, radio: int, since: float, *, is_reply: bool) -> list[float]:
    """When a side sent echo requests, or replies, along a radio."""
    first = wire.Echo(is_reply, 0, 0, 0).encode()[0]
    return [
        one.at
        for one in radios.envelopes(side, since)
        if one.path.socket == radio and one.datagram[wire.SHORT_HEADER_BYTES] == first
    ]


def test_tries_along_a_slow_network_are_airtimes_apart() -> None:
    """Those along LTE stay fast, and both ends do so."""
    radios = slow(0.03, 0.5)
    for radio in radios.radios:
        radio.is_dead = True
    radios.run(30.0)
    for side in (radios.a, radios.b):
        gaps = [later - earlier for earlier, later in pairwise(times(radios, side, SIK, wire.INITIATION))]
        assert gaps
        assert min(gaps) >= c.TRY_AIRTIMES * AIRTIME_S
        assert max(gaps) <= (1 + c.RETRY_JITTER) * c.TRY_AIRTIMES * AIRTIME_S + c.RETRY_MAX_S * (1 + c.RETRY_JITTER)
        assert len(times(radios, side, LTE, wire.INITIATION)) > 25


def test_a_slow_network_alone_is_tried_as_soon_as_it_is_due() -> None:
    """No other network sets the pace."""
    radios = slow(0.5, slow_sockets=(0,))
    radios.radios[0].is_dead = True
    radios.run(60.0)
    gaps = [later - earlier for earlier, later in pairwise(times(radios, radios.a, 0, wire.INITIATION))]
    least_s = c.TRY_AIRTIMES * AIRTIME_S
    assert all(least_s <= gap <= (1 + c.RETRY_JITTER) * least_s + 1e-6 for gap in gaps)


def test_a_fast_budget_does_not_slow_tries() -> None:
    """Four airtimes are less than the first wait."""
    assert facts(1e6).try_interval_s(Path(SIK, ("192.0.2.1", 1)), X25519) < c.RETRY_MIN_S
    radios = Radios((0.5,), link(), link())
    radios.a.node.set_budgets({0: 1e6})
    radios.radios[0].is_dead = True
    radios.run(2.0)
    assert len(times(radios, radios.a, 0, wire.INITIATION)) >= 6


def test_a_network_that_appears_is_tried_at_once() -> None:
    """A modem that is plugged in again does not wait for the airtimes of the tries that it did not send."""
    radios = slow(0.5, slow_sockets=(0,))
    radios.radios[0].is_dead = True
    radios.run(0.5)
    radios.a.node.set_socket_state(0, radios.now, is_up=False)
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    since = radios.now
    radios.run(0.01)
    assert len(times(radios, radios.a, 0, wire.INITIATION, since)) == 1


def test_a_network_that_flaps_does_not_hasten_the_tries_along_a_slow_one() -> None:
    """LTE appears every second, and other networks become metered. The radio keeps its pace."""
    radios = slow(0.03, 0.5)
    for radio in radios.radios:
        radio.is_dead = True
    for second in range(30):
        radios.run(1.0)
        radios.a.node.set_socket_state(LTE, radios.now, is_up=False)
        radios.a.node.set_metered([LTE] if second % 2 else [], radios.now)
        radios.a.node.set_socket_state(LTE, radios.now, is_up=True)
    gaps = [later - earlier for earlier, later in pairwise(times(radios, radios.a, SIK, wire.INITIATION))]
    assert len(gaps) > 5
    assert min(gaps) >= c.TRY_AIRTIMES * AIRTIME_S
    assert len(times(radios, radios.a, LTE, wire.INITIATION)) >= 30


def test_two_paths_of_one_slow_socket_are_tried_together() -> None:
    """They have one turn."""
    radios = slow(0.5, slow_sockets=(0,))
    paths = [Path(0, (f"10.0.0.{number}", 5790)) for number in (2, 3)]
    radios.a.node.set_paths(radios.a.peer, paths, 0.0)
    radios.radios[0].is_dead = True
    radios.run(1.0)
    assert [one.path for one in radios.sent if one.side is radios.a] == paths


def test_fast_tries_do_not_push_out_the_one_that_the_slow_network_carries() -> None:
    """LTE loses everything. The response along the radio arrives after more tries along LTE than are remembered."""
    radios = slow(0.03, 1.6)
    radios.radios[LTE].is_dead = True
    radios.run(3.5)
    assert len(times(radios, radios.a, LTE, wire.INITIATION)) > c.PENDING_PER_PEER
    assert radios.a.peer.sessions.current is not None
    assert radios.b.peer.sessions.current is not None


def test_a_slow_try_waits_longer_for_its_response() -> None:
    """With a large suite, airtimes are longer than the usual lifetime of an initiation."""
    interval_s = facts(400).try_interval_s(Path(SIK, ("192.0.2.1", 1)), SUITES_BY_NAME["mlkem768"])
    assert interval_s == pytest.approx(c.TRY_AIRTIMES * 8 * (1347 + 1207 + 96) / 400)
    radios = slow(15.0, slow_sockets=(0,))
    for side in (radios.a, radios.b):
        side.node.set_budgets({0: 300.0})
    radios.run(0.1)
    (pending,) = radios.a.peer.initiator.pending.values()
    assert pending.expires_at == pytest.approx(c.TRY_AIRTIMES * 8 * (147 + 103 + 96) / 300)


def test_tries_and_probes_follow_the_rate_and_freshness_follows_the_budget() -> None:
    """An attacker that delays answers lowers the rate. Frames must not become older by that."""
    radios = slow(0.5, slow_sockets=(0,))
    radios.run(5.0)
    peer, path = radios.a.peer, radios.state(radios.a, 0).path
    shared = peer.paths.facts
    before = shared.try_interval_s(path, X25519), shared.least_probe_s(path), shared.pace(path)
    radios.a.node.set_rates({0: BUDGET_BITS_S / 2}, radios.now)
    assert shared.try_interval_s(path, X25519) == 2 * before[0]
    assert shared.least_probe_s(path) == 2 * before[1]
    assert shared.pace(path) == peer.paths.pace == before[2]
    assert radios.a.node.next_deadline() == radios.now
    radios.a.node.set_rates({0: BUDGET_BITS_S}, radios.now)
    assert shared.try_interval_s(path, X25519) == before[0]


@pytest.mark.parametrize(
    ("budget", "interval_s", "hold_s", "ask_s"),
    [(1_600, 8.6, 2.0, 0.86), (4_000, 3.44, 1.376, 0.344), (9_600, 1.4333, 1.0, 0.25), (100_000, 0.1376, 1.0, 0.25)],
)
def test_pace_of_a_line(budget: float, interval_s: float, hold_s: float, ask_s: float) -> None:
    """As the table in section 11 says."""
    pace = facts(budget).pace(Path(SIK, (SERIAL_HOST, 0)))
    assert pace == pytest.approx(Pace(interval_s, hold_s, ask_s), rel=1e-4)


def test_pace_with_several_peers_and_without_a_budget() -> None:
    """Peers share the budget, so each is asked less often."""
    path = Path(SIK, ("192.0.2.1", 1))
    assert facts(peers=3).pace(path).interval_s == pytest.approx(3 * facts().pace(path).interval_s)
    assert facts().pace(path).hold_s == facts(peers=3).pace(path).hold_s
    assert facts().pace(Path(LTE, ("192.0.2.1", 1))) is FREE


def test_peers_elsewhere_do_not_slow_a_point_to_point_network() -> None:
    """One peer is at its other end, however many the node has."""
    line = Path(SIK, (SERIAL_HOST, 0))
    alone, crowded = facts(), facts(peers=6)
    crowded.set_point_to_point({SIK: ["ground-station"]})
    assert crowded.pace(line) == alone.pace(line)
    assert crowded.least_probe_s(line) == alone.least_probe_s(line)


def test_waits_grow_with_the_round_trip() -> None:
    """A path of 0.6 s: an answer takes longer than the ordinary time until a question."""
    radios = slow(0.4, slow_sockets=())
    radios.run(6.0, 0.5, radios.sender(radios.a), radios.sender(radios.b))
    peer = radios.a.peer
    assert peer.paths.round_trip_s == pytest.approx(0.8)
    assert peer.echo_after_s == pytest.approx(1.6)
    assert peer.handshake_after_s == pytest.approx(3.2)
    assert peer.lost_after_s == pytest.approx(6.4)
    since = radios.now
    radios.radios[0].is_dead = True
    radios.run(12.0, 0.5, radios.sender(radios.a))
    ((lost_at, _),) = radios.events(radios.a, PeerLost, since)
    assert lost_at - since >= 6.4 - 0.5
    assert times(radios, radios.a, 0, wire.INITIATION, since)[0] - since >= 3.2 - 0.5


def test_a_slow_round_trip_lengthens_waits_to_a_bound() -> None:
    """An attacker that slows the path does not hide a lost peer for long."""
    radios = slow(0.03)
    radios.run(3.0, 0.5, radios.sender(radios.a), radios.sender(radios.b))
    best = radios.a.peer.paths.best
    assert best is not None
    best.srtt_s = 100.0
    radios.a.peer.set_waits()
    assert radios.a.peer.lost_after_s == c.LOST_ROUND_TRIPS * c.LATE_AFTER_S


def test_echoes_along_the_only_path_fit_its_budget() -> None:
    """Requests and the replies to those of the peer take a twentieth, and a little for silences."""
    radios = slow(0.3, slow_sockets=(0,))
    radios.run(100.0, 0.5, radios.sender(radios.a), radios.sender(radios.b))
    requests = echoes(radios, radios.a, 0, 20.0, is_reply=False)
    interval_s = ECHO_AIRTIME_S / c.ECHO_BUDGET_SHARE
    assert 80 / interval_s / 2 < len(requests) <= 80 / interval_s + 2
    assert not radios.events(radios.b, FreshnessUnverified)
    assert len(radios.delivered(radios.b)) >= 195


def test_the_slow_path_gets_few_copies_of_echoes_when_the_fast_one_dies() -> None:
    """The requests are repeated four times a second while LTE is suspect. The radio becomes the best path."""
    radios = slow(0.03, 0.3)
    radios.run(30.0, 0.5, radios.sender(radios.a), radios.sender(radios.b, Class.CRITICAL))
    assert radios.a.peer.path == radios.state(radios.a, LTE).path
    since, radios.radios[LTE].is_dead = radios.now, True
    radios.run(10.0, 0.5, radios.sender(radios.a), radios.sender(radios.b, Class.CRITICAL))
    assert radios.a.peer.path == radios.state(radios.a, SIK).path
    for side in (radios.a, radios.b):
        for is_reply in (False, True):
            gaps = [
                later - earlier for earlier, later in pairwise(echoes(radios, side, SIK, since, is_reply=is_reply))
            ]
            assert len([gap for gap in gaps if gap < c.ASK_AIRTIMES * ECHO_AIRTIME_S - 1e-6]) <= 1
        assert times(radios, side, SIK, wire.INITIATION, since) == []
    assert not radios.events(radios.b, FreshnessUnverified, since)


def test_the_last_proof_lasts_as_long_as_on_the_new_best_path() -> None:
    """Longer on a slower network, and at most one lifetime from now on a faster one."""
    verification = Verification(0.0, 1.0)
    verification.answered(9.9, 10.0)
    assert verification.until == 12.0
    verification.set_pace(8.0, 2.0, 11.0)
    assert (verification.until, verification.ask_at) == (26.0, 17.9)
    verification.set_pace(1.0, 1.0, 12.0)
    assert (verification.until, verification.ask_at) == (14.0, 13.0)
    verification.refute()
    verification.set_pace(8.0, 2.0, 12.5)
    assert verification.until == verification.look_at == -c.NEVER


def test_an_answer_counts_as_one_that_took_as_long_as_frames_wait() -> None:
    """On a slow network both are longer."""
    verification = Verification(0.0, 1.0)
    verification.set_pace(8.0, 2.0, 0.0)
    verification.answered(20.0, 21.9)
    assert verification.until == 21.9 + 16.0
