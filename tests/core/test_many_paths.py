"""Several paths that carry one link: copies, what is sent where, what is asked when, and what failure costs."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.core.harness import ELSEWHERE, FRAME, datagrams, of, payloads, probe_in, reasons
from tests.core.radios import Radios, at_a, at_b, link
from uavlinkd.core import constants as c
from uavlinkd.core import establish, wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Deliver, PathChanged, PathStateChanged, PeerLost, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.settings import Class, Redundancy

CRITICAL, STREAM, BULK = Class
LONG = b"\xfd" + bytes(199)
"""A frame of 200 bytes."""


@pytest.fixture
def radios() -> Radios:
    """Two paths, both proved at both ends; the first is the faster one."""
    return Radios(delays_s=(0.02, 0.05)).run(1.0)


def numbered(number: int) -> bytes:
    """One of many frames."""
    return b"\xfd" + number.to_bytes(4, "big")


def cross(radios: Radios, radio: int, datagram: bytes, now: float | None = None) -> list[bytes]:
    """Bravo receives a datagram of alpha along a radio now. What it delivers."""
    return payloads(radios.b.node.receive(datagram, at_a(radio), radios.now if now is None else now))


# What goes where.


def test_critical_envelope_goes_along_every_path_and_is_delivered_once(radios: Radios) -> None:
    """The same bytes: a new counter would be a second delivery."""
    since = radios.now
    radios.send(radios.a, CRITICAL)
    radios.run(0.2)

    sent = radios.envelopes(radios.a, since)[:2]
    assert [(out.path, out.is_copy) for out in sent] == [(at_b(0), False), (at_b(1), True)]
    assert sent[0].datagram is sent[1].datagram
    assert [out.payload for out in radios.delivered(radios.b, since)] == [FRAME]


def test_stream_goes_along_the_best_path_alone(radios: Radios) -> None:
    """As does bulk."""
    for cls in (STREAM, BULK):
        (sent,) = of(radios.a.node.send(radios.a.peer, [FRAME], radios.now, cls), Transmit)
        assert (sent.path, sent.is_copy) == (at_b(0), False)


@pytest.mark.parametrize(("redundancy", "paths"), [(Redundancy.ALL, 2), (Redundancy.NONE, 1)])
def test_redundancy_is_configurable(redundancy: Redundancy, paths: int) -> None:
    """Every class along every path, or none."""
    radios = Radios(link_a=link(redundancy)).run(1.0)
    for cls in (CRITICAL, STREAM):
        assert len(of(radios.a.node.send(radios.a.peer, [FRAME], radios.now, cls), Transmit)) == paths


def test_critical_envelopes_are_short_while_two_paths_work(radios: Radios) -> None:
    """At most 320 bytes, which each path carries; a longer frame goes alone. The stream fills its envelopes."""
    frames = [FRAME] * 30 + [b"\xfd" + bytes(800)] + [FRAME] * 30
    critical = {out.datagram for out in of(radios.a.node.send(radios.a.peer, frames, 1.0, CRITICAL), Transmit)}
    lengths = sorted(map(len, critical))

    assert lengths[-1] > 800
    assert lengths[-2] <= c.CRITICAL_ENVELOPE_LIMIT
    assert max(map(len, datagrams(radios.a.node.send(radios.a.peer, [FRAME] * 60, 1.0)))) > 1000


def test_critical_envelopes_are_long_with_one_path() -> None:
    """The class has no effect then."""
    radios = Radios(delays_s=(0.02,)).run(1.0)

    (sent,) = datagrams(radios.a.node.send(radios.a.peer, [FRAME] * 50, radios.now, CRITICAL))
    assert len(sent) > c.CRITICAL_ENVELOPE_LIMIT
    assert not radios.a.peer.paths.is_multiple


def test_frames_do_not_fit_the_path_that_carries_only_short_envelopes() -> None:
    """Envelopes are as long as the best path carries; a copy does not go where it would be lost."""
    radios = Radios(link_a=link(Redundancy.ALL))
    radios.radios[1].loses = lambda datagram: len(datagram) > 600
    radios.run(20.0, 0.1, radios.sender(radios.a))

    assert radios.state(radios.a, 1).condition is PathCondition.USABLE
    long = of(radios.a.node.send(radios.a.peer, [LONG] * 5, radios.now), Transmit)
    assert {out.path for out in long} == {at_b(0)}
    short = of(radios.a.node.send(radios.a.peer, [LONG], radios.now), Transmit)
    assert {out.path for out in short} == {at_b(0), at_b(1)}


# Copies.


def test_copy_is_counted_along_its_path(radios: Radios) -> None:
    """It is a duplicate, received on its path, and answers nothing."""
    before, duplicates = radios.state(radios.b, 1).received, radios.state(radios.b, 1).duplicates
    counted = radios.b.peer.traffic.drops[DropReason.DUPLICATE]
    envelope = radios.pair.a.envelope(radios.now)
    assert cross(radios, 0, envelope) == [FRAME]
    assert radios.b.node.receive(envelope, at_a(1), radios.now) == []

    slow = radios.state(radios.b, 1)
    assert (slow.duplicates, slow.received) == (duplicates + 1, before + 1)
    assert radios.b.peer.traffic.drops[DropReason.DUPLICATE] == counted + 1


def test_repeat_along_the_same_path_hides_no_loss(radios: Radios) -> None:
    """An attacker that repeats datagrams cannot make the path look as if it lost none."""
    envelope = radios.pair.a.envelope(radios.now)
    cross(radios, 0, envelope)
    state = radios.state(radios.b, 0)
    received, duplicates = state.received, state.duplicates
    for _ in range(5):
        cross(radios, 0, envelope)

    assert (state.received, state.duplicates) == (received, duplicates + 5)


def test_repeats_below_the_replay_window_hide_no_loss(radios: Radios) -> None:
    """The receiver cannot tell any more along which paths these envelopes arrived, so it counts none of them."""
    envelopes = [radios.pair.a.envelope(radios.now) for _ in range(5)]
    for envelope in envelopes:
        cross(radios, 0, envelope)
    radios.a.session.send_counter += c.REPLAY_WINDOW
    cross(radios, 0, radios.pair.a.envelope(radios.now))
    states = [radios.state(radios.b, radio) for radio in (0, 1)]
    before = [(state.received, state.duplicates) for state in states]
    for radio in (0, 1):
        for envelope in envelopes:
            cross(radios, radio, envelope)

    assert [(state.received, state.duplicates - 5) for state in states] == before


def test_copy_from_elsewhere_is_counted_and_answered_with_nothing(radios: Radios) -> None:
    """A duplicate for two seconds; after that it is replayed."""
    envelope = radios.pair.a.envelope(radios.now)
    cross(radios, 0, envelope)
    assert radios.b.node.receive(envelope, ELSEWHERE, radios.now) == []
    assert radios.b.peer.paths.find(ELSEWHERE) is None
    radios.run(4.0, 0.2, radios.sender(radios.a))

    assert reasons(radios.b.node.receive(envelope, ELSEWHERE, radios.now)) == [DropReason.REPLAYED]
    late = radios.b.peer.traffic.drops[DropReason.LATE_COPY]
    assert radios.b.node.receive(envelope, at_a(1), radios.now) == []
    assert radios.b.peer.traffic.drops[DropReason.LATE_COPY] == late + 1


def test_copy_behind_the_window_changes_no_lag(radios: Radios) -> None:
    """Its place in the memory of arrivals is another envelope's by now."""
    since = radios.now
    envelope = radios.pair.a.envelope(since)
    cross(radios, 0, envelope)
    radios.a.session.send_counter += c.REPLAY_WINDOW - 1
    cross(radios, 0, radios.pair.a.envelope(since + 1.0), since + 1.0)
    cross(radios, 1, envelope, since + 1.0)

    question = radios.state(radios.b, 1).make_probe(1, 0, since + 1.0)
    assert question.lag_ms == 0xFFFF


def test_held_radio_that_is_released_delivers_nothing_old() -> None:
    """One path stalls for ten seconds: its copies are late, and what only it carried is delayed."""
    radios = Radios(both_configured=True).run(1.0)
    since = radios.now
    radios.radios[0].hold_until = since + 10.0
    sent: dict[bytes, float] = {}

    def command() -> None:
        frame = numbered(len(sent))
        sent[frame] = radios.now
        radios.send(radios.a, CRITICAL, frame)

    radios.run(12.0, 0.1, command, radios.sender(radios.a), radios.sender(radios.b))

    arrived = {
        seen.output.payload: seen.at - sent[seen.output.payload]
        for seen in radios.seen
        if seen.side is radios.b and isinstance(seen.output, Deliver) and seen.output.payload in sent
    }
    assert len(arrived) >= 119
    assert max(arrived.values()) < 0.1
    drops = radios.b.peer.traffic.drops
    assert drops[DropReason.LATE_COPY] > 20
    assert drops[DropReason.REPLAYED] == 0


def test_lag_of_copies_is_reported_to_their_sender(radios: Radios) -> None:
    """The slower path lags by the difference of the delays; the first one by nothing."""
    radios.run(6.0, 0.1, radios.sender(radios.a, CRITICAL), radios.sender(radios.a))

    assert radios.state(radios.a, 0).lag_s(radios.now) == 0.0
    assert radios.state(radios.a, 1).lag_s(radios.now) == pytest.approx(0.03, abs=0.002)


def test_order_grows_as_envelopes_were_sealed(radios: Radios) -> None:
    """Whatever the order of arrival, also from one session to the next."""
    now = radios.now
    sealed = [radios.pair.a.envelope(now, numbered(number)) for number in range(4)]
    orders = dict[bytes, int]()

    def receive(datagram: bytes) -> None:
        for out in of(radios.b.node.receive(datagram, at_a(1), now), Deliver):
            orders[out.payload] = out.order

    for number in (2, 0, 3):
        receive(sealed[number])
    radios.act(radios.a, establish.initiate(radios.a.peer, now))
    radios.run(0.5)
    now = radios.now
    assert radios.a.session.parameters.generation == 2
    receive(radios.pair.a.envelope(now, numbered(4)))
    receive(sealed[1])

    assert sorted(orders, key=orders.__getitem__) == [numbered(number) for number in range(5)]


def test_order_is_not_kept_for_one_path() -> None:
    """There nothing overtakes by a path's delay."""
    radios = Radios(delays_s=(0.02,)).run(1.0)
    (out,) = of(radios.b.node.receive(radios.pair.a.envelope(1.0), at_a(0), 1.0), Deliver)
    assert out.order == 0


# Probes.


def test_peer_with_one_path_gets_no_probes_from_its_initiator() -> None:
    """Its echo requests are the questions."""
    radios = Radios(delays_s=(0.02,)).run(20.0)
    radios.run(20.0, 0.2, radios.sender(radios.a))

    assert radios.questions(radios.a, 0, 1.0) == []
    state = radios.state(radios.a, 0)
    assert (state.condition, state.is_validated) == (PathCondition.USABLE, True)
    assert state.srtt_s == pytest.approx(0.04)


def test_path_of_the_stream_is_asked_four_times_a_second(radios: Radios) -> None:
    """And the standby each two seconds. A question that shares an envelope may be a little early."""
    radios.run(5.0, 0.02, radios.sender(radios.a))
    since = radios.now
    radios.run(10.0, 0.02, radios.sender(radios.a))

    assert 10.0 / c.PROBE_FAST_S - 1 <= len(radios.questions(radios.a, 0, since)) <= 10.0 / 0.2
    assert 4 <= len(radios.questions(radios.a, 1, since)) <= 6


def test_question_shares_an_envelope_of_the_stream(radios: Radios) -> None:
    """The frames behind it are delivered, and hardly a probe goes alone."""
    since = radios.now
    radios.run(5.0, 0.02, radios.sender(radios.a))
    alone = [
        sent
        for sent in radios.envelopes(radios.a, since)
        if sent.path == at_b(0) and sent.datagram[wire.SHORT_HEADER_BYTES : wire.SHORT_HEADER_BYTES + 2] == b"\3\0"
    ]

    assert len(radios.questions(radios.a, 0, since)) >= 18
    assert len(alone) <= 1 + len(radios.questions(radios.b, 0, since))
    assert {out.payload for out in radios.delivered(radios.b, since)} == {FRAME}
    assert len(radios.delivered(radios.b, since)) >= 249


def test_question_that_does_not_fit_goes_alone(radios: Radios) -> None:
    """A full envelope stays as it is."""
    radios.run(0.5, 0.02, radios.sender(radios.a))
    full = b"\xfd" + bytes(radios.a.session.payload_limit - 1)
    since = radios.now
    radios.run(2.0, 0.02, lambda: radios.send(radios.a, STREAM, full))

    assert {out.payload for out in radios.delivered(radios.b, since + 0.05)} == {full}
    assert len(radios.questions(radios.a, 0, since)) >= 6


def test_probes_are_never_copied(radios: Radios) -> None:
    """A probe belongs to one path."""
    radios.run(5.0, 0.05, radios.sender(radios.a), radios.sender(radios.a, CRITICAL))
    probes = [out for out in radios.sent if out.datagram[:1] == b"\x40" and out.datagram[5] == 3]

    assert len(probes) > 20
    assert not any(out.is_copy for out in probes)
    assert len({out.datagram for out in probes}) == len(probes)


def test_idle_link_is_asked_rarely(radios: Radios) -> None:
    """Each fifteen seconds, until frames are sent: then at once and often."""
    radios.run(30.0)
    since = radios.now
    radios.run(60.0)
    for radio in (0, 1):
        assert 3 <= len(radios.questions(radios.a, radio, since)) <= 5

    since = radios.now
    radios.run(1.0, 0.1, radios.sender(radios.a))
    assert len(radios.questions(radios.a, 0, since)) >= 3


def test_loss_of_each_direction_is_measured(radios: Radios) -> None:
    """Of all datagrams along the path, by the counts in probes: here every fifth frame of alpha is lost."""
    count = 0

    def lose(datagram: bytes) -> bool:
        nonlocal count
        count += len(datagram) > 300
        return len(datagram) > 300 and count % 5 == 0

    radios.radios[0].loses = lose
    radios.run(10.0, 0.02, lambda: radios.send(radios.a, STREAM, LONG, LONG))

    assert radios.state(radios.a, 0).loss_out == pytest.approx(0.185, abs=0.03)
    assert radios.state(radios.b, 0).loss_in == pytest.approx(0.185, abs=0.03)
    assert radios.state(radios.a, 0).loss_in == 0.0
    assert radios.state(radios.b, 0).loss_out == 0.0


def test_lost_probes_of_a_dead_path_count_on_no_other(radios: Radios) -> None:
    """Every frame arrives, and the path that carries it shows no loss."""
    radios.radios[1].is_dead = True
    radios.run(20.0, 0.05, radios.sender(radios.a), radios.sender(radios.b))

    assert radios.state(radios.a, 0).loss_out == 0.0
    assert radios.state(radios.b, 0).loss_in == 0.0


# Failure.


def gap(radios: Radios, since: float, kind: Class) -> float:
    """The longest time without a delivered frame at bravo, while alpha sends 50 a second."""
    arrivals = [since]
    seen = len(radios.seen)
    radios.run(6.0, 0.02, radios.sender(radios.a, kind), radios.sender(radios.b))
    arrivals += [out.at for out in radios.seen[seen:] if out.side is radios.b and isinstance(out.output, Deliver)]
    return max(later - earlier for earlier, later in pairwise(arrivals))


@pytest.mark.parametrize("delay_s", [0.01, 0.05, 0.15])
def test_stream_moves_within_half_a_second_after_its_path_died(delay_s: float) -> None:
    """At round trips of 20 to 300 ms; the reason is reported at both ends."""
    radios = Radios(delays_s=(delay_s, delay_s + 0.001)).run(1.0)
    radios.run(5.0, 0.02, radios.sender(radios.a), radios.sender(radios.b))
    radios.radios[0].is_dead = True

    limit_s = 0.5 if delay_s <= 0.05 else 0.9
    assert gap(radios, radios.now, STREAM) <= limit_s
    for side, here, there in ((radios.a, at_b(0), at_b(1)), (radios.b, at_a(0), at_a(1))):
        (change,) = (out for _, out in radios.events(side, PathChanged))
        assert change == PathChanged(side.peer, there, here, "unanswered")


def test_critical_frames_have_no_gap_when_a_path_dies(radios: Radios) -> None:
    """They come along the other path already."""
    radios.run(3.0, 0.02, radios.sender(radios.a, CRITICAL))
    radios.radios[0].is_dead = True

    assert gap(radios, radios.now, CRITICAL) <= 0.06


def test_no_critical_frame_is_lost_while_the_paths_take_turns_to_fail(radios: Radios) -> None:
    """Each is dead for three seconds of six; both are alive for a moment in between."""
    sent: list[bytes] = []

    def command() -> None:
        phase = radios.now % 6.0
        radios.radios[0].is_dead, radios.radios[1].is_dead = phase < 2.8, 3.0 <= phase < 5.8
        sent.append(numbered(len(sent)))
        radios.send(radios.a, CRITICAL, sent[-1])

    radios.run(30.0, 0.05, command, radios.sender(radios.b))
    radios.run(1.0)
    delivered = [out.payload for out in radios.delivered(radios.b)]
    assert len(delivered) == len(set(delivered))
    assert set(sent) <= set(delivered)


def test_path_that_comes_back_is_usable_after_two_seconds(radios: Radios) -> None:
    """It becomes the best only if it is better for two more; both changes are reported."""
    radios.radios[0].is_dead = True
    radios.run(5.0, 0.02, radios.sender(radios.a), radios.sender(radios.b))
    assert radios.a.peer.path == at_b(1)
    since = radios.now
    radios.radios[0].is_dead = False
    radios.run(10.0, 0.02, radios.sender(radios.a), radios.sender(radios.b))

    usable = [at - since for at, out in radios.events(radios.a, PathStateChanged, since)]
    assert len(usable) == 1
    assert c.RECOVERED_AFTER_S <= usable[0] <= c.RECOVERED_AFTER_S + 2 * c.PROBE_DOWN_S
    (change,) = radios.events(radios.a, PathChanged, since)
    assert change[1] == PathChanged(radios.a.peer, at_b(0), at_b(1), "faster")
    assert change[0] - since >= c.RECOVERED_AFTER_S + c.BETTER_FOR_S


def test_only_path_that_answers_is_used_at_once_however_lossy(radios: Radios) -> None:
    """The other one is dead; this one comes back and loses a third."""
    radios.radios[0].is_dead = radios.radios[1].is_dead = True
    radios.run(8.0, 0.1, radios.sender(radios.a), radios.sender(radios.b))
    lost = radios.events(radios.a, PeerLost)
    radios.radios[1].is_dead = False
    number = 0

    def lose(datagram: bytes) -> bool:
        nonlocal number
        number += 1
        return number % 3 == 0

    radios.radios[1].loses = lose
    radios.run(3.0, 0.1, radios.sender(radios.a), radios.sender(radios.b))
    assert len(lost) == 1
    assert radios.a.peer.is_up
    assert radios.a.peer.path == at_b(1)


def test_path_that_passes_probes_and_drops_frames_is_left(radios: Radios) -> None:
    """Its counts show it: it is suspect, and the other one is elected because of its loss."""
    radios.radios[0].loses = lambda datagram: len(datagram) > 200
    since = radios.now
    radios.run(8.0, 0.05, lambda: radios.send(radios.a, STREAM, LONG), radios.sender(radios.b))

    assert radios.a.peer.path == at_b(1)
    ((at, change),) = radios.events(radios.a, PathChanged)
    assert at < since + 4.0
    assert change == PathChanged(radios.a.peer, at_b(1), at_b(0), "loss")


def test_network_that_is_gone_moves_traffic_at_once(radios: Radios) -> None:
    """Without an unanswered question."""
    radios.a.node.set_socket_state(0, radios.now, is_up=False)
    radios.act(radios.a, radios.a.timeout(radios.now))

    assert radios.events(radios.a, PathChanged) == [
        (radios.now, PathChanged(radios.a.peer, at_b(1), at_b(0), "network"))
    ]
    for cls in Class:
        sent = of(radios.a.node.send(radios.a.peer, [FRAME], radios.now, cls), Transmit)
        assert [out.path for out in sent] == [at_b(1)]


def test_changed_network_is_asked_at_once(radios: Radios) -> None:
    """Its address may be another one, and its paths have to prove themselves."""
    since = radios.now
    radios.a.node.set_socket_state(1, since, is_up=True)
    radios.run(0.01)

    assert radios.questions(radios.a, 1, since) == [since]


# Echoes, close, and bytes.


def test_close_goes_along_every_path(radios: Radios) -> None:
    """It is critical."""
    closing = of(radios.a.node.close(radios.now), Transmit)
    assert {out.path for out in closing} == {at_b(0), at_b(1)}


def test_silent_peer_is_asked_along_every_path(radios: Radios) -> None:
    """The echo request half a second after frames that nothing answered."""
    radios.radios[0].is_dead = radios.radios[1].is_dead = True
    since = radios.now
    radios.send(radios.a)
    radios.run(c.ECHO_AFTER_S + 0.1)

    asked = [out for out in radios.envelopes(radios.a, since + 0.001) if out.datagram[5] == wire.ECHO_REQUEST]
    assert {out.path for out in asked if out.datagram == asked[0].datagram} == {at_b(0), at_b(1)}


def test_metered_path_carries_critical_frames_and_rare_probes() -> None:
    """Not the stream, although it is faster."""
    radios = Radios(delays_s=(0.02, 0.1))
    for side in (radios.a, radios.b):
        side.node.set_metered([0], 0.0)
    radios.run(5.0)
    since = radios.now
    radios.run(60.0, 0.1, radios.sender(radios.a))

    assert radios.a.peer.path == at_b(1)
    assert 3 <= len(radios.questions(radios.a, 0, since)) <= 5
    sent = of(radios.a.node.send(radios.a.peer, [FRAME], radios.now, CRITICAL), Transmit)
    assert {out.path for out in sent} == {at_b(0), at_b(1)}


def test_metered_path_is_asked_only_when_needed_if_configured_so() -> None:
    """No question for minutes; when the other path dies it is asked and used."""
    radios = Radios(delays_s=(0.02, 0.1), link_a=link(idle_probe_s=0.0))
    radios.a.node.set_metered([0], 0.0)
    radios.run(3.0, 0.1, radios.sender(radios.a))
    since = radios.now
    radios.run(60.0, 0.1, radios.sender(radios.a))
    assert radios.questions(radios.a, 0, since) == []

    radios.radios[1].is_dead = True
    radios.run(6.0, 0.1, radios.sender(radios.a), radios.sender(radios.b))
    assert radios.a.peer.path == at_b(0)
    assert radios.a.peer.is_up


def test_questions_to_forged_addresses_are_bounded(radios: Radios) -> None:
    """An attacker that sends captured envelopes first, from many addresses: never more bytes than it sent there."""
    sent_there: dict[Path, int] = {}
    outputs = []
    for number in range(50):
        place = Path(0, (f"203.0.113.{number}", 1))
        envelope = radios.pair.a.envelope(radios.now, LONG)
        sent_there[place] = len(envelope)
        outputs += radios.b.node.receive(envelope, place, radios.now)
    radios.run(20.0, 0.5, radios.sender(radios.a))
    got = dict.fromkeys(sent_there, 0)
    asked = [(out.path, out.datagram) for out in of(outputs, Transmit)]
    asked += [(sent.path, sent.datagram) for sent in radios.sent if sent.side is radios.b]
    for path, datagram in asked:
        if path in got:
            got[path] += len(datagram)

    assert all(got[place] <= sent_there[place] for place in got)
    assert [state.path for state in radios.b.peer.paths.states] == [at_a(0), at_a(1)]
    assert radios.b.peer.traffic.paths_unproven == 50


def test_answer_reports_what_came_along_its_path(radios: Radios) -> None:
    """A question along the slower path gets the counts and the lag of that path."""
    radios.run(2.0, 0.1, radios.sender(radios.a, CRITICAL))
    now, state = radios.now, radios.state(radios.a, 1)
    record = state.make_probe(7, 0, now).encode()
    (answer,) = datagrams(radios.b.node.receive(radios.pair.a.envelope(now, record), at_a(1), now))

    probe = probe_in(radios.a, answer)
    assert probe.answer == 7
    assert probe.received == radios.state(radios.b, 1).received
    assert probe.lag_ms == pytest.approx(30, abs=1)


def test_copy_on_the_previous_session_counts_on_no_path(radios: Radios) -> None:
    """The counts in probes are of the current session."""
    envelope = radios.pair.a.envelope(radios.now)
    cross(radios, 0, envelope)
    radios.act(radios.a, establish.initiate(radios.a.peer, radios.now))
    radios.run(0.5)
    state, counted = radios.state(radios.b, 1), radios.b.peer.traffic.drops[DropReason.DUPLICATE]
    received, duplicates = state.received, state.duplicates
    cross(radios, 1, envelope)

    assert (state.received, state.duplicates) == (received, duplicates + 1)
    assert radios.b.peer.traffic.drops[DropReason.DUPLICATE] == counted + 1
