"""Several paths that carry one link: copies, what is sent where, and what is asked when."""

from __future__ import annotations

import random
from functools import partial
from itertools import count

import pytest

from tests.protocol.harness import FRAME, datagrams, of, payloads
from tests.protocol.radios import Radios, at_a, at_b, link
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Deliver, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.send import ask_for_echo, send_again
from uavlinkd.protocol.settings import Class, Redundancy

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


def targets(radios: Radios, cls: Class, *frames: bytes) -> list[Path]:
    """Where alpha sends frames (one by default) of a class now."""
    return [out.path for out in of(radios.a.node.send(radios.a.peer, frames or (FRAME,), radios.now, cls), Transmit)]


# What goes where.


def test_critical_envelope_goes_along_every_path_and_is_delivered_once(radios: Radios) -> None:
    """The same bytes: a new counter would be a second delivery. Stream and bulk go along the best path alone."""
    since = radios.now
    radios.send(radios.a, CRITICAL)
    radios.run(0.2)
    sent = radios.envelopes(radios.a, since)[:2]
    assert [out.path for out in sent] == [at_b(0), at_b(1)]
    assert sent[0].datagram is sent[1].datagram
    assert [out.payload for out in radios.delivered(radios.b, since)] == [FRAME]
    for cls in (STREAM, BULK):
        (out,) = of(radios.a.node.send(radios.a.peer, [FRAME], radios.now, cls), Transmit)
        assert out.path == at_b(0)


def test_copy_for_which_a_path_has_no_room_yet_is_counted_when_it_leaves(radios: Radios) -> None:
    """A copy is the datagram that left along the first path, with the same bytes. While it waits it costs nothing."""
    peer, (first, later) = radios.a.peer, (radios.state(radios.a, radio) for radio in (0, 1))

    def totals() -> tuple[int, ...]:
        return later.sent, later.datagrams_sent, later.bytes_sent, *peer.paths.totals[:2]

    (sent,) = of(radios.a.node.send(peer, [FRAME], radios.now, CRITICAL, (first,)), Transmit)
    before, size = totals(), len(sent.datagram)
    assert sent.path == first.path
    assert send_again(peer, later, sent.datagram) == Transmit(sent.datagram, later.path)
    assert [total - was for total, was in zip(totals(), before, strict=True)] == [1, 1, size, 1, size]
    assert cross(radios, 1, sent.datagram) == [FRAME]
    assert cross(radios, 0, sent.datagram) == []


def test_nothing_leaves_along_a_slot_that_was_removed_a_moment_ago(radios: Radios) -> None:
    """The totals of the peer, which its budget pays for, would miss it. The other path carries critical frames."""
    peer, path = radios.a.peer, radios.state(radios.a, 0).path
    before = peer.paths.totals
    radios.a.node.remove_path(path, radios.now)
    assert [targets(radios, cls) for cls in (STREAM, CRITICAL)] == [[], [at_b(1)]]
    assert peer.paths.totals.datagrams_sent == before.datagrams_sent + 1
    radios.act(radios.a, radios.a.timeout(radios.now))
    assert targets(radios, STREAM) == [at_b(1)]


def test_critical_envelopes_are_short_while_two_paths_work(radios: Radios) -> None:
    """At most 320 bytes, which each path carries; a longer frame goes alone. Others may be longer."""
    radios.measure_lengths()
    frames = [FRAME] * 30 + [b"\xfd" + bytes(800)] + [FRAME] * 30
    critical = {out.datagram for out in of(radios.a.node.send(radios.a.peer, frames, 1.0, CRITICAL), Transmit)}
    lengths = sorted(map(len, critical))
    assert lengths[-1] > 800
    assert lengths[-2] <= c.CRITICAL_ENVELOPE_LIMIT
    assert max(map(len, datagrams(radios.a.node.send(radios.a.peer, [FRAME] * 60, 1.0)))) > 1000
    radios = Radios(delays_s=(0.02,)).run(1.0).measure_lengths()
    (sent,) = datagrams(radios.a.node.send(radios.a.peer, [FRAME] * 50, radios.now, CRITICAL))
    assert len(sent) > c.CRITICAL_ENVELOPE_LIMIT
    assert not radios.a.peer.paths.is_multiple


def test_frames_do_not_fit_the_path_that_carries_only_short_envelopes() -> None:
    """Envelopes are as long as the best path carries; a copy does not go where it would be lost."""
    radios = Radios(link_a=link(Redundancy.ALL))
    radios.radios[1].loses = lambda datagram: len(datagram) > 600
    radios.run(4.0, 0.1, radios.sender(radios.a)).measure_lengths()
    assert radios.state(radios.a, 1).condition is PathCondition.USABLE
    assert targets(radios, STREAM, *[LONG] * 5) == [at_b(0)]
    assert targets(radios, STREAM, LONG) == [at_b(0), at_b(1)]


def test_new_session_names_the_path_on_which_it_was_made(radios: Radios) -> None:
    """Also while another one stays the best: two machines with one key are noticed by where their sessions begin."""
    (initiation, *_) = datagrams(establish.initiate(radios.a.peer, radios.now))
    (response,) = datagrams(radios.b.node.receive(initiation, at_a(0), radios.now))
    (confirmation, *_) = datagrams(radios.a.node.receive(response, at_b(0), radios.now))
    confirmed = radios.b.node.receive(confirmation, at_a(1), radios.now)
    assert [event.path for event in of(confirmed, SessionEstablished)] == [at_a(1)]
    assert radios.b.peer.path == at_a(0)


# Copies.


def test_copy_is_counted_once_along_each_path(radios: Radios) -> None:
    """It is a duplicate, and answers nothing. An attacker that repeats datagrams cannot hide a loss."""
    states = [radios.state(radios.b, radio) for radio in (0, 1)]
    before = [(state.received, state.duplicates) for state in states]
    envelope, drops = radios.pair.a.envelope(radios.now), radios.b.peer.traffic.drops
    counted = drops[DropReason.DUPLICATE]
    assert cross(radios, 0, envelope) == [FRAME]
    for radio in (1, 0, 0, 1):
        assert radios.b.node.receive(envelope, at_a(radio), radios.now) == []
    assert [(state.received - 1, state.duplicates - 2) for state in states] == before
    assert drops[DropReason.DUPLICATE] == counted + 4


def test_repeats_below_the_replay_window_hide_no_loss(radios: Radios) -> None:
    """The receiver cannot tell any more along which paths these envelopes arrived, so it counts none of them."""
    since = radios.now
    envelopes = [radios.pair.a.envelope(since) for _ in range(5)]
    for envelope in envelopes:
        cross(radios, 0, envelope)
    radios.a.session.send_counter += c.REPLAY_WINDOW
    cross(radios, 0, radios.pair.a.envelope(since))
    states = [radios.state(radios.b, radio) for radio in (0, 1)]
    before = [(state.received, state.duplicates) for state in states]
    for radio in (0, 1):
        for envelope in envelopes:
            cross(radios, radio, envelope)
    assert [(state.received, state.duplicates - 5) for state in states] == before
    assert states[1].copy_lag_s is None, "their places in the memory are of other envelopes"


def test_lag_of_copies_is_measured_where_they_arrive(radios: Radios) -> None:
    """The slower path lags by the difference of the delays."""
    radios.run(6.0, 0.1, radios.sender(radios.a, CRITICAL), radios.sender(radios.a))
    assert radios.state(radios.b, 0).copy_lag_s == 0.0
    assert radios.state(radios.b, 1).copy_lag_s == pytest.approx(0.03, abs=0.002)


def test_order_grows_as_envelopes_were_sealed(radios: Radios) -> None:
    """Whatever the order of arrival, also from one session to the next. With one path nothing overtakes."""
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
    single = Radios(delays_s=(0.02,)).run(1.0)
    (out,) = of(single.b.node.receive(single.pair.a.envelope(1.0), at_a(0), 1.0), Deliver)
    assert out.order == 0


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


# Probes.


def test_idle_link_is_asked_rarely(radios: Radios) -> None:
    """Each fifteen seconds, until frames are sent: then at once and often."""
    radios.run(30.0)
    since = radios.now
    radios.run(60.0)
    assert all(3 <= len(radios.questions(radios.a, radio, since)) <= 5 for radio in (0, 1))
    since = radios.now
    radios.run(1.0, 0.1, radios.sender(radios.a))
    assert len(radios.questions(radios.a, 0, since)) >= 3


# Echoes, close, and bytes.


def test_close_and_questions_about_a_silence_go_along_every_path(radios: Radios) -> None:
    """They are critical. The echo request follows half a second after frames that nothing answered."""
    radios.radios[0].is_dead = radios.radios[1].is_dead = True
    since = radios.now
    radios.send(radios.a)
    radios.run(c.ECHO_AFTER_S + 0.1)
    asked = [out for out in radios.envelopes(radios.a, since + 0.001) if out.datagram[5] == wire.ECHO_REQUEST]
    assert {out.path for out in asked if out.datagram == asked[0].datagram} == {at_b(0), at_b(1)}
    assert {out.path for out in of(radios.a.node.close(radios.now), Transmit)} == {at_b(0), at_b(1)}


def test_request_is_answered_along_each_path_by_which_it_comes() -> None:
    """Once for each: the other paths may not carry the answer. Further copies get none, and a slow path few.

    It gets few requests too.
    """
    radios = Radios().run(3.0)

    def answers() -> list[list[Path]]:
        asked = of(ask_for_echo(radios.a.peer, radios.a.session, radios.now), Transmit)
        assert [out.path for out in asked] == [at_b(0), at_b(1)]
        received = [radios.b.node.receive(asked[0].datagram, at_a(radio), radios.now) for radio in (0, 1, 1, 0)]
        return [[out.path for out in of(outputs, Transmit)] for outputs in received]

    assert answers() == [[at_a(0)], [at_a(1)], [], []]
    radios.b.node.facts.set_budgets({1: 1600})
    assert [answers(), answers()] == [[[at_a(0)], [at_a(1)], [], []], [[at_a(0)], [], [], []]]
    radios.a.node.facts.set_budgets({1: 1600})
    requests = [ask_for_echo(radios.a.peer, radios.a.session, radios.now) for _ in range(2)]
    assert [len(of(outputs, Transmit)) for outputs in requests] == [2, 1]


def test_slow_path_does_not_bring_doubt_back() -> None:
    """Its late replies are not the newest proof: after a silence one answer is enough, and frames pass at once."""
    radios = Radios(delays_s=(0.02, 1.2), both_configured=True).run(3.0, 0.1, lambda: None)
    radios.run(c.LATE_AFTER_S + 0.5)
    numbers = count()
    radios.run(10.0, 0.04, lambda: radios.send(radios.a, CRITICAL, numbered(next(numbers))))
    ages = [
        seen.at - next(sent.at for sent in radios.sent if seen.output.payload in sent.datagram)
        for seen in radios.seen
        if seen.side is radios.b and seen.at >= radios.now - 6.0 and isinstance(seen.output, Deliver)
    ]
    assert len(ages) > 140
    assert max(ages) < 0.03, "none was held for a round trip"


# The longest envelope.

BURST = [LONG] * 6


@pytest.mark.parametrize("delays_s", [(0.02,), (0.3,), (0.02, 0.05)])
def test_path_that_drops_long_envelopes_in_flight_gets_short_ones(delays_s: tuple[float, ...]) -> None:
    """The peer's counts show it within 2 s. The tests themselves are no losses, and lose no frames."""
    radios = Radios(delays_s, both_configured=True).run(3.0)
    best, sent_at = radios.state(radios.a, 0), list[float]()

    def burst() -> None:
        sent_at.append(radios.now)
        radios.send(radios.a, STREAM, *BURST)
        radios.send(radios.b)
        radios.b.peer.missing(radios.now)

    radios.run(3.0, 0.1, burst)
    assert best.envelope_limit.limit == c.DEFAULT_ENVELOPE_LIMIT
    for radio in radios.radios:
        radio.loses = lambda datagram: len(datagram) > 1096
    radios.run(2.0, 0.1, burst)
    assert best.envelope_limit.limit < 1096
    since = radios.now
    radios.run(30.0, 0.1, burst).run(1.0)
    arrived = b"".join(out.payload for out in radios.delivered(radios.b, since + delays_s[0]))
    assert arrived.count(LONG) == len(BURST) * sum(at >= since for at in sent_at)
    assert (best.envelope_limit.limit, best.envelope_limit.dropped) == (1024, c.DEFAULT_ENVELOPE_LIMIT)
    assert best.loss_out < 0.01
    assert radios.b.peer.missing(radios.now) < 20


@pytest.mark.parametrize("delays_s", [(0.02,), (0.02, 0.05)])
def test_bad_radio_does_not_seem_to_drop_long_envelopes(delays_s: tuple[float, ...]) -> None:
    """A fifth of all datagrams is lost, in each direction."""
    radios, rng = Radios(delays_s, both_configured=True).run(3.0), random.Random(1)
    for radio in radios.radios:
        radio.loses = lambda _: rng.random() < 0.2
    senders = partial(radios.send, radios.a, STREAM, *BURST), radios.sender(radios.b)
    radios.run(120.0, 0.2, *senders)
    limit = radios.state(radios.a, 0).envelope_limit
    for _ in range(20):  # losses make a sender doubt the limit, until a test is answered
        if limit.limit < c.DEFAULT_ENVELOPE_LIMIT:
            radios.run(0.4, 0.2, *senders)
    assert (limit.limit, limit.dropped) == (c.DEFAULT_ENVELOPE_LIMIT, 0)
    tests = [sent for sent in radios.envelopes(radios.a, 3.0) if len(sent.datagram) == c.DEFAULT_ENVELOPE_LIMIT]
    assert len(tests) < 60 * len(delays_s)
