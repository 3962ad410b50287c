"""A handshake along several paths: one session, whichever of its datagrams are lost."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.core.harness import (
    ELSEWHERE,
    UNUSED_INDEX,
    Pair,
    datagrams,
    exchange,
    exhaust,
    of,
    only,
    probe_in,
    quiet,
    reasons,
)
from tests.core.radios import Radios, at_a, at_b, link
from uavlinkd.core import constants as c
from uavlinkd.core import establish, wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import PathChanged, PeerUp, SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.settings import Class


def initiation(radios: Radios, now: float = 0.0) -> dict[int, bytes]:
    """Alpha's next initiation, by radio."""
    sent = of(radios.a.timeout(now), Transmit)
    return {out.path.socket: out.datagram for out in sent if out.datagram[0] == wire.INITIATION}


def initiations(radios: Radios) -> list[float]:
    """When alpha initiated."""
    return sorted({sent.at for sent in radios.sent if sent.side is radios.a and sent.datagram[0] == wire.INITIATION})


def cookie_reply(radios: Radios, datagram: bytes, path: Path, now: float) -> bytes:
    """Bravo's cookie for a sender along a path."""
    index = wire.parse_initiation(datagram).sender_index
    return radios.b.node._handshakes.own.cookies.reply(datagram, index, path, now)


# Responses.


def test_session_is_made_although_the_fastest_path_loses_responses() -> None:
    """An attacker on one path cannot deny the handshake: the response goes along the other one too."""
    radios = Radios(delays_s=(0.02, 0.2))
    radios.radios[0].loses = lambda datagram: datagram[0] == wire.RESPONSE
    radios.run(2.0)

    up = [at for at, _ in radios.events(radios.a, PeerUp)]
    assert up == [pytest.approx(0.4)]
    assert radios.a.peer.is_up
    assert radios.b.peer.is_up
    assert radios.b.peer.traffic.drops[DropReason.DUPLICATE] >= 1


@pytest.mark.parametrize("dead", [0, 1])
def test_session_is_made_along_the_path_that_works(dead: int) -> None:
    """The dead one costs no time."""
    radios = Radios(delays_s=(0.05, 0.05))
    radios.radios[dead].is_dead = True
    radios.run(1.0)

    assert [at for at, _ in radios.events(radios.a, PeerUp)] == [pytest.approx(0.1)]
    assert radios.a.peer.path == at_b(1 - dead)
    assert radios.b.peer.path == at_a(1 - dead)


def test_copies_of_an_initiation_get_the_same_response_once_along_each_path() -> None:
    """Without a key exchange; each copy counts as a duplicate."""
    radios = Radios()
    message = initiation(radios)
    assert message[0] == message[1]
    (first,) = radios.b.node.receive(message[0], at_a(0), 0.0)
    copy, counted = radios.b.node.receive(message[1], at_a(1), 0.1)

    assert isinstance(first, Transmit)
    assert copy == Transmit(first.datagram, at_a(1), is_copy=True)
    assert reasons([counted]) == [DropReason.DUPLICATE]
    for radio in (0, 1):
        again = radios.b.node.receive(message[radio], at_a(radio), 0.2)
        assert datagrams(again) == []
        assert reasons(again) == [DropReason.DUPLICATE]
    assert radios.b.peer.traffic.drops == {DropReason.DUPLICATE: 3}


def test_copies_spend_no_answer_of_the_peer() -> None:
    """Two paths do not halve the number of handshakes that the responder answers."""
    radios = Radios()
    for number in range(c.ANSWERS_BURST):
        message = initiation(radios, 2.0 * number)
        for radio in (0, 1):
            out = radios.b.node.receive(message[radio], at_a(radio), 0.0)
            assert len(datagrams(out, wire.RESPONSE)) == 1


def test_response_goes_along_a_bounded_number_of_paths() -> None:
    """An attacker that copies an initiation from many addresses gets no more."""
    radios = Radios()
    message = initiation(radios)[0]
    places = [Path(0, (f"203.0.113.{number}", 1)) for number in range(2 * c.COPIES_OF_A_RESPONSE)]
    answered = [bool(datagrams(radios.b.node.receive(message, place, 0.0))) for place in places]

    assert answered == [True] * c.COPIES_OF_A_RESPONSE + [False] * c.COPIES_OF_A_RESPONSE


def test_copy_after_the_confirmation_is_a_replay() -> None:
    """The session is there, and the recording gets no answer."""
    radios = Radios()
    message = initiation(radios)[0]
    response = only(datagrams(radios.b.node.receive(message, at_a(0), 0.0)))
    confirmation = datagrams(radios.a.node.receive(response, at_b(0), 0.0))[0]
    radios.b.node.receive(confirmation, at_a(0), 0.0)

    assert reasons(radios.b.node.receive(message, at_a(1), 0.1)) == [DropReason.REPLAYED_INITIATION]


def test_second_response_is_a_duplicate() -> None:
    """The initiator uses the first; a response to a session that it does not have is unexpected."""
    radios = Radios()
    message = initiation(radios)[0]
    response = only(datagrams(radios.b.node.receive(message, at_a(0), 0.0)))
    assert of(radios.a.node.receive(response, at_b(0), 0.1), SessionEstablished)

    assert reasons(radios.a.node.receive(response, at_b(1), 0.2)) == [DropReason.DUPLICATE]
    foreign = response[:2] + bytes((response[2] ^ 1,)) + response[3:]
    assert reasons(radios.a.node.receive(foreign, at_b(1), 0.2)) == [DropReason.UNEXPECTED_RESPONSE]


def test_response_from_another_address_makes_the_session_where_it_was_asked() -> None:
    """A relay's address, or one that the NAT has just changed: traffic goes along the likeliest path."""
    radios = Radios()
    response = only(datagrams(radios.b.node.receive(initiation(radios)[1], at_a(1), 0.0)))

    outputs = radios.a.node.receive(response, ELSEWHERE, 0.1)

    assert of(outputs, SessionEstablished)
    assert radios.a.peer.path == at_b(0)
    assert radios.a.peer.paths.find(ELSEWHERE) is None


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
    asked = {out.path for out in of(outputs, Transmit) if _asks(radios, out.datagram)}
    assert asked == {at_a(0), at_a(1)}
    frames = radios.b.send(0.3)
    assert [out.path for out in of(frames, Transmit)] == [at_a(1)]


def _asks(radios: Radios, datagram: bytes) -> bool:
    is_probe = datagram[wire.SHORT_HEADER_BYTES] == 3
    return is_probe and bool(probe_in(radios.a, datagram).question)


def test_both_ends_use_both_paths_after_one_round_trip() -> None:
    """Bravo knew no address of alpha before."""
    radios = Radios(delays_s=(0.02, 0.1)).run(1.0)

    for side in (radios.a, radios.b):
        assert [state.condition for state in side.peer.paths.states] == [PathCondition.USABLE] * 2
        assert side.peer.paths.is_multiple


def test_new_keys_change_neither_the_paths_nor_the_election() -> None:
    """The rekey goes along the best path; the other one is usable all the time."""
    radios = Radios(delays_s=(0.1, 0.02)).run(10.0)
    radios.run(6.0, 0.1, radios.sender(radios.a), radios.sender(radios.b))
    assert radios.a.peer.path == at_b(1)
    changes = len(radios.events(radios.a, PathChanged))
    radios.run(c.REKEY_AFTER_S, 0.5, radios.sender(radios.a), radios.sender(radios.b))

    assert radios.a.session.parameters.generation == 2
    assert radios.a.peer.path == at_b(1)
    assert len(radios.events(radios.a, PathChanged)) == changes
    assert all(state.condition is PathCondition.USABLE for state in radios.a.peer.paths.states)
    sent = [sent for sent in radios.sent if sent.side is radios.a and sent.at > 100.0]
    rekeys = [out.path for out in sent if out.datagram[0] == wire.INITIATION]
    assert rekeys == [at_b(1)]


def test_third_try_at_new_keys_goes_along_every_path() -> None:
    """The best path may carry envelopes and lose initiations."""
    radios = Radios().run(2.0)
    radios.radios[0].loses = radios.radios[1].loses = lambda datagram: datagram[0] == wire.INITIATION
    radios.run(c.REKEY_AFTER_S + 2.0, 0.25, radios.sender(radios.a), radios.sender(radios.b))
    tries: dict[float, int] = {}
    for sent in radios.sent:
        if sent.side is radios.a and sent.datagram[0] == wire.INITIATION and sent.at > 100.0:
            tries[sent.at] = tries.get(sent.at, 0) + 1

    assert list(tries.values())[: c.REKEYS_ALONG_BEST + 1] == [1] * c.REKEYS_ALONG_BEST + [2]


# Cookies.


def test_cookie_belongs_to_its_path() -> None:
    """The next initiation carries along each path the cookie that came there."""
    radios = Radios()
    message = initiation(radios)
    for radio in (0, 1):
        reply = cookie_reply(radios, message[radio], at_a(radio), 0.0)
        assert radios.a.node.receive(reply, at_b(radio), 0.1) == []

    again = initiation(radios, 0.5)
    jar = radios.b.node._handshakes.own.cookies
    assert again[0][:-16] == again[1][:-16]
    for radio in (0, 1):
        assert jar.has_valid_mac2(again[radio], at_a(radio), 0.5)
        assert not jar.has_valid_mac2(again[radio], at_a(1 - radio), 0.5)


def test_one_cookie_is_accepted_for_each_message_and_path() -> None:
    """An observer can make more, and has to be faster than the peer on each path."""
    radios = Radios()
    message = initiation(radios)
    for radio in (0, 1):
        reply = cookie_reply(radios, message[radio], at_a(radio), 0.0)
        assert radios.a.node.receive(reply, at_b(radio), 0.1) == []
        assert reasons(radios.a.node.receive(reply, at_b(radio), 0.1)) == [DropReason.UNEXPECTED_COOKIE]
    elsewhere = cookie_reply(radios, message[0], ELSEWHERE, 0.0)
    assert reasons(radios.a.node.receive(elsewhere, ELSEWHERE, 0.1)) == [DropReason.UNEXPECTED_COOKIE]


def test_link_comes_up_under_load_along_both_paths() -> None:
    """Each path proves its own address."""
    radios = Radios()
    radios.run(1.0, 0.01, lambda: exhaust(radios.b, radios.now))

    assert radios.a.peer.is_up
    assert len(initiations(radios)) == 2
    assert radios.b.peer.paths.is_multiple


# Metered paths.


def test_metered_path_is_not_used_for_a_rekey_while_another_works() -> None:
    """It is only probed."""
    radios = Radios()
    radios.a.node.set_metered([0], 0.0)
    radios.run(1.0)
    assert radios.a.peer.path == at_b(1)
    radios.radios[1].loses = lambda datagram: datagram[0] == wire.INITIATION
    radios.run(c.REKEY_AFTER_S + 1.0, 0.25, radios.sender(radios.a), radios.sender(radios.b))

    tried = {s.path for s in radios.sent if s.side is radios.a and s.datagram[0] == wire.INITIATION and s.at > 100.0}
    assert tried == {at_b(1)}


def test_peer_that_is_off_costs_little_on_a_metered_path() -> None:
    """Fast tries for a minute, then every 15 s, after ten minutes every 60 s; a changed network begins again."""
    radios = Radios(delays_s=(0.05,))
    radios.a.node.set_metered([0], 0.0)
    radios.radios[0].is_dead = True
    radios.run(1200.0)
    tries = initiations(radios)

    assert sum(at < 60.0 for at in tries) > 30
    assert 36 <= sum(60.0 <= at < 600.0 for at in tries) <= 37
    assert 10 <= sum(at >= 600.0 for at in tries) <= 11
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(5.0)
    assert len(initiations(radios)) >= len(tries) + 4


def test_network_that_flaps_does_not_hasten_the_tries_along_a_metered_one() -> None:
    """The other network appears every second. After a minute the metered one is tried every 15 s all the same."""
    radios = Radios()
    radios.a.node.set_metered([0], 0.0)
    radios.radios[0].is_dead = radios.radios[1].is_dead = True
    for _ in range(180):
        radios.run(1.0)
        radios.a.node.set_socket_state(1, radios.now, is_up=True)
    tries = {radio: [s.at for s in radios.sent if s.path == at_b(radio) and s.at > 60.0] for radio in (0, 1)}

    assert 7 <= len(tries[0]) <= 9
    assert len(tries[1]) > 120


def test_metered_setting_hastens_no_try() -> None:
    """The path that is not metered any more is tried when it was due."""
    radios = Radios(delays_s=(0.05,))
    radios.radios[0].is_dead = True
    radios.run(100.0)
    tries, due_at = len(initiations(radios)), radios.a.peer.initiator.retry_at
    radios.a.node.set_metered([], radios.now)
    assert radios.a.peer.initiator.retry_at == due_at > radios.now
    radios.run(due_at - radios.now)
    assert len(initiations(radios)) - tries <= 1


# A network appears.


def test_network_that_appears_is_tried_at_once() -> None:
    """Whatever the next try was to wait for."""
    radios = Radios(delays_s=(0.05,))
    radios.radios[0].is_dead = True
    radios.run(30.0)
    radios.radios[0].is_dead = False
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(0.2)

    assert radios.a.peer.is_up
    assert radios.a.node.send(radios.a.peer, [], radios.now, Class.CRITICAL) == []


def test_network_that_appears_hastens_no_try_to_a_peer_that_is_not_there() -> None:
    """The peer has no path on it."""
    radios = Radios(delays_s=(0.05,))
    radios.radios[0].is_dead = True
    radios.run(30.0)
    due_at = radios.a.peer.initiator.retry_at
    radios.a.node.set_socket_state(1, radios.now, is_up=True)
    assert radios.a.peer.initiator.retry_at == due_at > radios.now


def test_idle_link_needs_no_answer_of_a_path_whose_network_is_gone() -> None:
    """No datagram goes there until the network is back, also if frames are sent as soon as it is gone."""
    radios = Radios(link_a=link(), link_b=link()).run(1.0)
    radios.radios[1].is_dead = True
    radios.a.node.set_socket_state(1, radios.now, is_up=False)
    radios.run(20.0, 0.5, radios.sender(radios.a))
    assert [sent for sent in radios.sent if sent.side is radios.a and sent.at > 1.0 and sent.path.socket == 1] == []

    since, radios.radios[1].is_dead = radios.now, False
    radios.a.node.set_socket_state(1, since, is_up=True)
    radios.run(0.01)
    assert radios.questions(radios.a, 1, since) == [since]


def test_nothing_is_sent_while_every_network_is_gone() -> None:
    """The first one that appears is tried."""
    radios = Radios()
    for radio in (0, 1):
        radios.a.node.set_socket_state(radio, 0.0, is_up=False)
    radios.run(10.0)
    assert radios.sent == []

    radios.a.node.set_socket_state(1, radios.now, is_up=True)
    radios.run(0.3)
    assert radios.a.peer.is_up


def test_metered_path_is_tried_rarely_beside_another_of_a_peer_that_is_off() -> None:
    """Every 15 s after the first minute, while the other path is tried as often as ever."""
    radios = Radios()
    radios.a.node.set_metered([0], 0.0)
    radios.radios[0].is_dead = radios.radios[1].is_dead = True
    radios.run(180.0)
    tries = {radio: [s.at for s in radios.sent if s.path == at_b(radio) and s.at > 60.0] for radio in (0, 1)}

    assert 7 <= len(tries[0]) <= 9
    assert len(tries[1]) > 60


def test_metered_path_that_is_asked_only_when_needed_gets_no_question_of_a_new_session() -> None:
    """New keys are made along the other path, which works."""
    radios = Radios(link_a=link(idle_probe_s=0.0))
    radios.a.node.set_metered([1], 0.0)
    radios.run(1.0)
    since = radios.now
    radios.run(c.REKEY_AFTER_S + 1.0)

    assert radios.a.session.parameters.generation == 2
    assert radios.questions(radios.a, 1, since) == []


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
    outputs = pair.a.receive(only(datagrams(pair.b.receive(initiation, 1.0))), 1.0)

    assert pair.a.session is current
    confirmation = only(of(outputs, Transmit))
    assert confirmation.path == pair.a.peer_at
    assert len(pair.a.peer.sessions.confirmed) == 2
    pair.b.receive(confirmation.datagram, 1.0)
    assert len(pair.b.peer.sessions.confirmed) == 2


def test_hint_does_not_hasten_the_tries_along_a_metered_path() -> None:
    """Any sender can forge an envelope with an unknown index; after a minute each byte counts."""
    radios = Radios(delays_s=(0.05,))
    radios.a.node.set_metered([0], 0.0)
    radios.radios[0].is_dead = True
    radios.run(100.0)
    tries = len(initiations(radios))
    stray = wire.envelope_header(UNUSED_INDEX, 5) + bytes(24)
    for _ in range(8):
        radios.act(radios.a, radios.a.node.receive(stray, at_b(0), radios.now))
        radios.run(1.0)

    assert len(initiations(radios)) - tries <= 1
