"""Networks with a budget: tries, echoes, waits and probes by airtime, and the longest envelopes."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.protocol.harness import AT_B, FRAME, KEY_C, Pair, Side, datagrams, exchange, only
from tests.protocol.radios import Radios, link
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.outputs import PeerLost
from uavlinkd.protocol.path import FREE, SERIAL_HOST, Pace, Path, SocketFacts
from uavlinkd.protocol.path_measures import limit_at
from uavlinkd.protocol.settings import Class, Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519
from uavlinkd.protocol.wire import ANSWER_BYTES, QUESTION_BYTES

LTE, SIK = 0, 1
BUDGET_BITS_S = 4_000
AIRTIME_S = 8 * (147 + 103 + 2 * 48) / BUDGET_BITS_S
"""Of an initiation and its response with `x25519`."""
LEAST_TRY_S = c.TRY_AIRTIMES * AIRTIME_S
PLACE, LINE = Path(SIK, ("192.0.2.1", 1)), Path(SIK, (SERIAL_HOST, 0))


def facts(budget_bits_s: float = BUDGET_BITS_S, peers: int = 1) -> SocketFacts:
    """One network with a budget."""
    made = SocketFacts()
    made.set_budgets({SIK: budget_bits_s})
    made.peers = peers
    return made


def slow(*delays_s: float, slow_sockets: tuple[int, ...] = (SIK,), dead: bool = False) -> Radios:
    """Radios of which some have a budget at both ends."""
    radios = Radios(delays_s, link(), link(), both_configured=True)
    for side in (radios.a, radios.b):
        side.node.facts.set_budgets(dict.fromkeys(slow_sockets, BUDGET_BITS_S))
    for radio in radios.radios:
        radio.is_dead = dead
    return radios


def tries(radios: Radios, side: Side, radio: int, since: float = 0.0) -> list[float]:
    """When a side initiated along a radio."""
    sent = (one for one in radios.sent if one.side is side and one.at >= since)
    return [one.at for one in sent if one.path.socket == radio and one.datagram[0] == wire.INITIATION]


def gaps(moments: list[float]) -> list[float]:
    """The times between them."""
    return [later - earlier for earlier, later in pairwise(moments)]


# Tries.


@pytest.mark.parametrize("flaps", [False, True])
def test_tries_along_a_slow_network_are_airtimes_apart(flaps: bool) -> None:
    """Those along LTE stay fast, also if it appears every second, and other networks become metered."""
    radios = slow(0.03, 0.5, dead=True)
    for second in range(30):
        radios.run(1.0)
        if flaps:
            radios.a.node.set_socket_state(LTE, radios.now, is_up=False)
            radios.a.node.set_metered([LTE] if second % 2 else [], radios.now)
            radios.a.node.set_socket_state(LTE, radios.now, is_up=True)
    for side in (radios.a, radios.b):
        waits = gaps(tries(radios, side, SIK))
        assert len(waits) > 5
        assert min(waits) >= LEAST_TRY_S
        assert max(waits) <= (1 + c.RETRY_JITTER) * (LEAST_TRY_S + c.RETRY_MAX_S)
        assert len(tries(radios, side, LTE)) > 25


def test_a_slow_network_alone_sets_the_pace() -> None:
    """Two paths of one socket have one turn. A modem that is plugged in again does not wait for its airtimes."""
    radios = slow(0.5, slow_sockets=(0,), dead=True)
    paths = [Path(0, (f"10.0.0.{number}", 5790)) for number in (2, 3)]
    radios.a.node.set_paths(radios.a.peer, paths, 0.0)
    radios.run(1.0)
    assert [one.path for one in radios.sent if one.side is radios.a] == paths
    radios = slow(0.5, slow_sockets=(0,), dead=True)
    radios.run(60.0)
    waits = gaps(tries(radios, radios.a, 0))
    assert all(LEAST_TRY_S <= gap <= (1 + c.RETRY_JITTER) * LEAST_TRY_S + 1e-6 for gap in waits)
    for is_up in (False, True):
        radios.a.node.set_socket_state(0, radios.now, is_up=is_up)
    since = radios.now
    radios.run(0.01)
    assert len(tries(radios, radios.a, 0, since)) == 1


def test_slow_tries_wait_longer_for_their_response() -> None:
    """LTE loses everything, and its tries do not push out the one that the radio carries. Large suites need more."""
    radios = slow(0.03, 1.6)
    radios.radios[LTE].is_dead = True
    radios.run(3.5)
    assert len(tries(radios, radios.a, LTE)) > c.PENDING_PER_PEER
    assert radios.a.peer.sessions.current is not None
    assert radios.b.peer.sessions.current is not None
    interval_s = facts(400).try_interval_s(PLACE, SUITES_BY_NAME["mlkem768"])
    assert interval_s == pytest.approx(c.TRY_AIRTIMES * 8 * (1347 + 1207 + 96) / 400)
    radios = slow(15.0, slow_sockets=(0,))
    radios.a.node.facts.set_budgets({0: 300.0})
    radios.run(0.1)
    (pending,) = radios.a.peer.initiator.pending.values()
    assert pending.expires_at == pytest.approx(c.TRY_AIRTIMES * 8 * (147 + 103 + 96) / 300)


# Probes, echoes and freshness.


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
    [
        (1_600, 8.6, 2.0, 0.86),
        (4_000, 3.44, 1.376, 0.344),
        (9_600, 1.4333, 1.0, 0.14333),
        (100_000, 0.1376, 1.0, 0.1),
    ],
)
def test_pace_of_a_line(budget: float, interval_s: float, hold_s: float, ask_s: float) -> None:
    """As the table in section 11 says."""
    assert facts(budget).pace(LINE) == pytest.approx(Pace(interval_s, hold_s, ask_s), rel=1e-4)


def test_peers_share_a_budget_but_not_that_of_a_point_to_point_network() -> None:
    """So each is asked less often. At the other end of a line is one peer, however many the node has."""
    alone, three = facts().pace(PLACE), facts(peers=3).pace(PLACE)
    assert three == pytest.approx(alone._replace(interval_s=3 * alone.interval_s))
    assert facts().pace(Path(LTE, PLACE.address)) is FREE
    crowded = facts(peers=6)
    crowded.set_point_to_point({SIK: "ground-station"})
    assert crowded.pace(LINE) == facts().pace(LINE)
    assert crowded.least_probe_s(LINE) == facts().least_probe_s(LINE)


def test_probes_use_at_most_a_twentieth_of_a_budget() -> None:
    """Of all peers together. On a network that is fast, or without a budget, they are a small part anyway."""
    echoed = sum(len(wire.Echo(is_reply, 0, 0, 0).encode()) for is_reply in (False, True))
    around = 2 * (wire.LONG_HEADER_BYTES + 16)
    assert (QUESTION_BYTES + ANSWER_BYTES + around, echoed + around) == (c.PROBE_BYTES, c.ECHO_BYTES)
    pair = Pair()
    node, paths = pair.a.node, pair.a.peer.paths
    state = paths.by_path[AT_B]
    free_s = paths.interval_s(state, 0.0)
    least_s = 8 * (c.PROBE_BYTES + 2 * c.IP_BYTES) / (c.PROBE_BUDGET_SHARE * BUDGET_BITS_S)
    assert free_s < least_s
    node.facts.set_budgets({AT_B.socket: BUDGET_BITS_S})
    assert paths.interval_s(state, 0.0) == pytest.approx(least_s)
    other = node.add_peer(PeerSettings("other", KEY_C.public), 0.0)
    assert paths.interval_s(state, 0.0) == pytest.approx(2 * least_s)
    node.remove_peer(other, 0.0)
    assert paths.interval_s(state, 0.0) == pytest.approx(least_s)
    for budgets in ({AT_B.socket + 1: BUDGET_BITS_S}, {AT_B.socket: 10_000_000}):
        node.facts.set_budgets(budgets)
        assert paths.interval_s(state, 0.0) == free_s


def test_waits_grow_with_the_round_trip_to_a_bound() -> None:
    """An answer takes longer than the ordinary time until a question. An attacker cannot hide a lost peer."""
    radios = slow(0.4, slow_sockets=())
    radios.run(6.0, 0.5, radios.sender(radios.a), radios.sender(radios.b))
    peer = radios.a.peer
    assert peer.paths.round_trip_s == pytest.approx(0.8)
    assert (peer.echo_after_s, peer.handshake_after_s, peer.lost_after_s) == pytest.approx((1.6, 3.2, 6.4))
    since = radios.now
    radios.radios[0].is_dead = True
    radios.run(12.0, 0.5, radios.sender(radios.a))
    ((lost_at, _),) = radios.events(radios.a, PeerLost, since)
    assert lost_at - since >= 6.4 - 0.5
    assert tries(radios, radios.a, 0, since)[0] - since >= 3.2 - 0.5
    radios.radios[0].is_dead = False
    radios.run(8.0, 0.5, radios.sender(radios.a), radios.sender(radios.b))
    radios.state(radios.a, 0).srtt_s = 100.0
    peer.set_waits()
    assert peer.lost_after_s == c.LOST_ROUND_TRIPS * c.LATE_AFTER_S


def test_first_waits_of_a_session_are_those_of_its_handshake() -> None:
    """A peer that answered an initiation late answers the first envelopes late too, until one is answered sooner."""
    for response_s, (echo_s, handshake_s, lost_s) in ((0.1, (0.5, 1.0, 3.0)), (0.5, (1, 2, 4)), (9.0, (4, 8, 16))):
        pair = Pair(Link(), Link())
        response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0), wire.RESPONSE))
        sent, peer = pair.a.receive(response, response_s), pair.a.peer
        assert (peer.echo_after_s, peer.handshake_after_s, peer.lost_after_s) == (echo_s, handshake_s, lost_s)
        exchange(pair.b, pair.a, sent, response_s)
        assert (peer.echo_after_s, peer.handshake_after_s, peer.lost_after_s) == (0.5, 1.0, 3.0)


def test_only_path_is_not_asked_fast_beside_its_echo_requests() -> None:
    """Before the first answer: these ask too."""
    pair = Pair(Link(), Link())
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0), wire.RESPONSE))
    pair.a.receive(response, 0.0)
    (state,) = pair.a.peer.paths.states
    assert not state.works
    asked = []
    for tick in range(1, 26):
        pair.a.timeout(tick / 10)
        asked.append(state.questioned_at)
    assert sorted(set(asked)) == pytest.approx([0.1, 1.1, 2.1])


# The longest envelopes.

LIMIT = 150
LONG_FRAME = FRAME[:1] + bytes(279)
"""As long as the longest MAVLink frame."""


def two_radios(limits: dict[int, int]) -> Radios:
    """Both ends send along LTE and a slow radio, with these limits by socket."""
    radios = Radios((0.02, 0.2), link(), link(), both_configured=True)
    for side in (radios.a, radios.b):
        side.node.facts.envelope_limits = limits
    radios.run(8.0, 0.1, radios.sender(radios.a), radios.sender(radios.b)).measure_lengths()
    assert all(radios.state(radios.a, radio).works for radio in (LTE, SIK))
    return radios


def sent_lengths(radios: Radios, cls: Class, frames: list[bytes]) -> dict[int, list[int]]:
    """The lengths of the envelopes along each radio that carry these frames of alpha."""
    before = len(radios.sent)
    radios.send(radios.a, cls, *frames)
    sent = radios.sent[before:]
    return {radio: [len(one.datagram) for one in sent if one.path.socket == radio] for radio in (LTE, SIK)}


@pytest.mark.parametrize(
    ("bits_s", "limit"), [(1_600, 120), (4_000, 120), (4_001, 120), (8_000, 245), (9_600, 295), (40_000, 500)]
)
def test_limit_is_what_a_quarter_of_a_second_carries(bits_s: float, limit: int) -> None:
    """With the framing on the line or the headers of IP, and between 120 and 500 bytes."""
    assert limit_at(bits_s) == limit
    assert limit in (c.SLOW_ENVELOPE_LEAST, c.SLOW_ENVELOPE_MOST) or 8 * (limit + c.LINE_BYTES) == bits_s / 4
    assert limit_at(8_000, 48) == 250 - 48


def test_critical_envelopes_fit_the_slowest_path_and_those_of_the_stream_the_best() -> None:
    """The copies are bit-identical, so the one along LTE is as short. The longest frame goes alone, along both."""
    radios = two_radios({SIK: LIMIT})
    lengths = sent_lengths(radios, Class.CRITICAL, [FRAME] * 20)
    assert lengths[LTE] == lengths[SIK]
    assert max(lengths[LTE]) <= LIMIT
    lengths = sent_lengths(radios, Class.CRITICAL, [FRAME, LONG_FRAME, FRAME])
    assert lengths[LTE] == lengths[SIK]
    assert [length > LIMIT for length in lengths[SIK]] == [False, True, False]
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)
    assert len(lengths[LTE]) == 1
    assert lengths[LTE][0] > 20 * len(FRAME)
    assert lengths[SIK] == []


def test_stream_that_is_too_long_for_the_slow_path_is_not_copied_there() -> None:
    """While the best path is suspect, its envelopes go along the other one too, as far as they fit."""
    radios = two_radios({SIK: LIMIT})
    radios.radios[LTE].is_dead = True
    radios.run(0.35, 0.1, radios.sender(radios.a))
    assert len(radios.a.peer.paths.routes[Class.STREAM]) == 2
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)
    assert (len(lengths[LTE]), lengths[SIK]) == (1, [])
    lengths = sent_lengths(radios, Class.STREAM, [LONG_FRAME])
    assert lengths[LTE] == lengths[SIK] != []


@pytest.mark.parametrize(("limits", "envelopes"), [({0: LIMIT}, 4), ({}, 1)])
def test_the_only_path_has_its_limit_too(limits: dict[int, int], envelopes: int) -> None:
    """Frames of all classes share its envelopes."""
    radios = Radios((0.2,), link(), link(), both_configured=True)
    radios.a.node.facts.envelope_limits = limits
    radios.run(3.0, 0.1, radios.sender(radios.a)).measure_lengths()
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)[0]
    assert len(lengths) == envelopes
    assert not limits or max(lengths) <= LIMIT


def test_a_question_joins_an_envelope_only_within_the_limit() -> None:
    """The probe in front of frames counts."""
    radios = two_radios({LTE: LIMIT})
    fitting = LIMIT - radios.a.session.envelope_bytes(0)
    for size, joins in ((fitting - QUESTION_BYTES - 2, True), (fitting - QUESTION_BYTES + 1, False)):
        radios.state(radios.a, LTE).question_at = radios.now
        lengths = sent_lengths(radios, Class.STREAM, [FRAME[:1] + bytes(size - 1)])
        assert lengths[LTE] == [radios.a.session.envelope_bytes(size + QUESTION_BYTES * joins)]


@pytest.mark.parametrize("limit", [120, LIMIT, 500])
def test_no_probe_is_longer_than_the_limit(limit: int) -> None:
    """LTE is tested with the longest envelope, the slow radio never with more than it may carry."""
    radios = two_radios({SIK: limit})
    longest = {
        radio: max(len(one.datagram) for one in radios.sent if one.path.socket == radio) for radio in (LTE, SIK)
    }
    assert longest[LTE] == radios.a.session.max_envelope
    assert longest[SIK] <= max(limit, 147)  # an initiation
