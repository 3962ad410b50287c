"""A handshake along several paths: one session, whichever of its datagrams are lost."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.protocol.harness import (
    ELSEWHERE,
    KEY_B,
    Pair,
    datagrams,
    exchange,
    flipped,
    of,
    only,
    probe_in,
    quiet,
    reasons,
    repaired,
    stray,
)
from tests.protocol.radios import Radios, at_a, at_b
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import SessionEstablished, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition


def initiation(radios: Radios, now: float = 0.0) -> dict[int, bytes]:
    """Alpha's next initiation, by radio."""
    sent = of(radios.a.timeout(now), Transmit)
    return {out.path.socket: out.datagram for out in sent if out.datagram[0] == wire.INITIATION}


def initiations(radios: Radios, radio: int | None = None, since: float = 0.0) -> list[float]:
    """When alpha initiated, along one radio or along any."""
    return sorted(
        {
            sent.at
            for sent in radios.sent
            if sent.side is radios.a
            and sent.datagram[0] == wire.INITIATION
            and sent.at >= since
            and radio in (None, sent.path.socket)
        }
    )


def dead(radios: int) -> Radios:
    """Radios that carry nothing; the first one is metered."""
    made = Radios(delays_s=(0.05,) * radios)
    made.a.node.set_metered([0], 0.0)
    for radio in made.radios:
        radio.is_dead = True
    return made


# Responses.


def test_copies_of_an_initiation_get_the_same_response_once_along_each_path() -> None:
    """Without a key exchange, and each copy counts as a duplicate. They spend no answer of the peer."""
    radios = Radios()
    for number in range(c.ANSWERS.burst):
        message = initiation(radios, 2.0 * number)
        assert message[0] == message[1]
        (first,) = radios.b.node.receive(message[0], at_a(0), 0.0)
        copy, counted = radios.b.node.receive(message[1], at_a(1), 0.0)
        assert isinstance(first, Transmit)
        assert copy == Transmit(first.datagram, at_a(1))
        assert reasons([counted]) == [DropReason.DUPLICATE]
        for radio in (0, 1):
            again = radios.b.node.receive(message[radio], at_a(radio), 0.2)
            assert (datagrams(again), reasons(again)) == ([], [DropReason.DUPLICATE])


def test_response_goes_along_a_bounded_number_of_paths_until_it_is_confirmed() -> None:
    """An attacker that copies an initiation from many addresses gets no more, and is noticed."""
    radios = Radios()
    message = initiation(radios)[0]
    response = only(datagrams(radios.b.node.receive(message, at_a(0), 0.0)))
    places = [Path(0, (f"203.0.113.{number}", 1)) for number in range(2 * c.COPIES_OF_A_RESPONSE)]
    answered = [bool(datagrams(radios.b.node.receive(message, place, 0.0))) for place in places]
    assert answered == [number < c.COPIES_OF_A_RESPONSE - 1 for number in range(len(places))]
    confirmation = datagrams(radios.a.node.receive(response, at_b(0), 0.0))[0]
    radios.b.node.receive(confirmation, at_a(0), 0.0)
    late = [only(reasons(radios.b.node.receive(message, place, 0.1))) for place in places]
    assert late[: c.COPIES_OF_A_RESPONSE - 1] == [DropReason.DUPLICATE] * (c.COPIES_OF_A_RESPONSE - 1)
    assert set(late[c.COPIES_OF_A_RESPONSE - 1 :]) == {DropReason.REPLAYED_INITIATION}


def test_slow_copy_of_an_initiation_is_no_replay() -> None:
    """It comes after the confirmation along the fast path. An altered one, or one that is too late, is a replay."""
    radios = Radios()
    message = initiation(radios)
    response = only(datagrams(radios.b.node.receive(message[0], at_a(0), 0.0)))
    confirmation = datagrams(radios.a.node.receive(response, at_b(0), 0.0))[0]
    radios.b.node.receive(confirmation, at_a(0), 0.01)
    late = 0.01 + c.INITIATION_COPIES_S
    altered = repaired(flipped(message[1], 60), KEY_B.public)
    for datagram, now, reason in (
        (message[1], 0.05, DropReason.DUPLICATE),
        (message[1], late - 0.02, DropReason.DUPLICATE),
        (altered, late - 0.02, DropReason.REPLAYED_INITIATION),
        (message[1], late, DropReason.REPLAYED_INITIATION),
    ):
        out = radios.b.node.receive(datagram, at_a(1), now)
        assert (datagrams(out), reasons(out)) == ([], [reason])


def test_second_response_is_a_duplicate() -> None:
    """The initiator uses the first; a response to a session that it does not have is unexpected."""
    radios = Radios()
    response = only(datagrams(radios.b.node.receive(initiation(radios)[0], at_a(0), 0.0)))
    assert of(radios.a.node.receive(response, at_b(0), 0.1), SessionEstablished)
    assert reasons(radios.a.node.receive(response, at_b(1), 0.2)) == [DropReason.DUPLICATE]
    foreign = response[:2] + bytes((response[2] ^ 1,)) + response[3:]
    assert reasons(radios.a.node.receive(foreign, at_b(1), 0.2)) == [DropReason.UNEXPECTED_RESPONSE]


def test_session_of_lower_rank_is_confirmed_where_it_was_made() -> None:
    """Generations are at their end: the session of the smaller key's initiation stays the current one."""
    pair = Pair(link_a=quiet(), link_b=quiet(), swapped=True)
    pair.a.node.set_paths(pair.a.peer, [], 0.0)
    pair.b.configure_path(0.0)
    response = only(datagrams(pair.a.receive(only(datagrams(pair.b.timeout(0.0))), 0.0)))
    exchange(pair.a, pair.b, pair.b.receive(response, 0.0), 0.0)
    for side in (pair.a, pair.b):
        side.session.parameters = replace(side.session.parameters, generation=2**32 - 1)
    current = pair.a.session
    pair.a.configure_path(1.0)
    initiation = only(datagrams(establish.initiate(pair.a.peer, 1.0)))
    confirmation = only(of(pair.a.receive(only(datagrams(pair.b.receive(initiation, 1.0))), 1.0), Transmit))
    assert pair.a.session is current
    assert confirmation.path == pair.a.peer_at
    pair.b.receive(confirmation.datagram, 1.0)
    assert [len(side.peer.sessions.confirmed) for side in (pair.a, pair.b)] == [2, 2]


# Validation.


def test_handshake_validates_no_path() -> None:
    """The responder sends along the path of the first envelope, and a question along each that had the response."""
    radios = Radios()
    message = initiation(radios)
    response = [datagrams(radios.b.node.receive(message[radio], at_a(radio), 0.0))[0] for radio in (0, 1)]
    confirmation = datagrams(radios.a.node.receive(response[0], at_b(0), 0.1))[0]
    outputs = radios.b.node.receive(confirmation, at_a(1), 0.2)
    states = {state.path: state.condition for state in radios.b.peer.paths.states}
    assert states == dict.fromkeys((at_a(0), at_a(1)), PathCondition.UNPROVEN)
    assert radios.b.peer.path == at_a(1)
    probes = [out for out in of(outputs, Transmit) if out.datagram[wire.SHORT_HEADER_BYTES] == 3]
    assert {out.path for out in probes if probe_in(radios.a, out.datagram).question} == {at_a(0), at_a(1)}
    assert [out.path for out in of(radios.b.send(0.3), Transmit)] == [at_a(1)]


def test_third_try_at_new_keys_goes_along_every_path() -> None:
    """The best path may carry envelopes and lose initiations."""
    radios = Radios().run(2.0)
    radios.radios[0].loses = radios.radios[1].loses = lambda datagram: datagram[0] == wire.INITIATION
    radios.run(c.REKEY_AFTER_S + 2.0, 0.25, radios.sender(radios.a), radios.sender(radios.b))
    along = [initiations(radios, radio, since=100.0) for radio in (0, 1)]
    assert along[0][c.REKEYS_ALONG_BEST :] == along[1]


# Cookies.


def test_cookie_belongs_to_its_path_and_one_is_accepted_for_each_message() -> None:
    """The next initiation carries along each path the cookie that came there. Observers have to be faster."""
    radios = Radios()
    message, jar = initiation(radios), radios.b.node._handshakes.cookies
    index = wire.parse_initiation(message[0]).sender_index
    for radio in (0, 1):
        reply = jar.reply(message[radio], index, at_a(radio), 0.0)
        assert radios.a.node.receive(reply, at_b(radio), 0.1) == []
        assert reasons(radios.a.node.receive(reply, at_b(radio), 0.1)) == [DropReason.UNEXPECTED_COOKIE]
    elsewhere = jar.reply(message[0], index, ELSEWHERE, 0.0)
    assert reasons(radios.a.node.receive(elsewhere, ELSEWHERE, 0.1)) == [DropReason.UNEXPECTED_COOKIE]
    again = initiation(radios, 0.5)
    assert again[0][:-16] == again[1][:-16]
    for radio in (0, 1):
        assert jar.has_valid_mac2(again[radio], at_a(radio), 0.5)
        assert not jar.has_valid_mac2(again[radio], at_a(1 - radio), 0.5)


# Metered paths.


def test_peer_that_is_off_costs_little_on_a_metered_path() -> None:
    """Fast tries for a minute, then every 15 s, after ten minutes every 60 s; a changed network begins again."""
    radios = dead(1).run(1200.0)
    tries = initiations(radios)
    assert sum(at < 60.0 for at in tries) > 30
    assert 29 <= sum(60.0 <= at < 600.0 for at in tries) <= 36
    assert 8 <= sum(at >= 600.0 for at in tries) <= 10
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(5.0)
    assert len(initiations(radios)) >= len(tries) + 4


@pytest.mark.parametrize(("flaps", "others"), [(False, 60), (True, 120)])
def test_metered_path_is_tried_rarely_beside_another_of_a_peer_that_is_off(flaps: bool, others: int) -> None:
    """Every 15 s after the first minute, while the other path is tried as often as ever, or appears every second."""
    radios = dead(2)
    for _ in range(180):
        radios.run(1.0)
        if flaps:
            radios.a.node.set_socket_state(1, radios.now, is_up=True)
    assert 5 <= len(initiations(radios, 0, since=60.1)) <= 8
    assert len(initiations(radios, 1, since=60.1)) > others


@pytest.mark.parametrize("hint", ["forged index", "not metered any more", "another network"])
def test_nothing_but_its_own_network_hastens_the_tries_along_a_metered_path(hint: str) -> None:
    """Any sender can forge an envelope with an unknown index; after a minute each byte counts."""
    radios = dead(1).run(100.0)
    tries, due_at = len(initiations(radios)), radios.a.peer.initiator.retry_at
    assert due_at > radios.now
    for _ in range(8):
        if hint == "forged index":
            radios.act(radios.a, radios.a.node.receive(stray(), at_b(0), radios.now))
        elif hint == "another network":
            radios.a.node.set_socket_state(1, radios.now, is_up=True)
        elif radios.now == 100.0:
            radios.a.node.set_metered([], radios.now)
        radios.run(min(1.0, due_at - radios.now))
    assert len(initiations(radios)) - tries <= 1


# A network appears.


def test_network_that_appears_is_tried_at_once() -> None:
    """Whatever the next try was to wait for. Nothing is sent while every network is gone."""
    radios = Radios()
    for radio in (0, 1):
        radios.a.node.set_socket_state(radio, 0.0, is_up=False)
    radios.run(10.0)
    assert radios.sent == []
    radios.a.node.set_socket_state(1, radios.now, is_up=True)
    radios.run(0.3)
    assert radios.a.peer.is_up


def test_new_connection_carries_an_initiation_at_once() -> None:
    """Its other end may have restarted, and know no session: the initiation does not wait for a silence."""
    radios = Radios().run(5.0)
    assert radios.a.peer.is_up
    tries = len(initiations(radios))
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(0.3)
    assert len(initiations(radios)) == tries  # a network of datagrams
    radios.a.node.facts.add_stream(0)
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(0.3)
    assert len(initiations(radios)) > tries
