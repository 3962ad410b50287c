"""Calling a peer: how often, where, and what may still answer."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.core.harness import (
    AT_B,
    ELSEWHERE,
    KEY_A,
    Pair,
    datagrams,
    exchange,
    flipped,
    lively,
    of,
    only,
    quiet,
    reasons,
    repaired,
    with_macs,
)
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Path, SessionEstablished, Transmit
from uavlinkd.core.settings import Link

OTHER: Path = (1, "203.0.113.5", 14600)


def calls(pair: Pair, amount: int, start: float = 0.0) -> list[tuple[float, Transmit]]:
    """Alpha's next so many initiations, and when each was made."""
    made: list[tuple[float, Transmit]] = []
    now = start
    for _ in range(20 * amount):
        made += [(now, out) for out in of(pair.a.timeout(now), Transmit) if out.datagram[0] == wire.INITIATION]
        if len(made) >= amount:
            return made
        now = pair.a.node.next_deadline()
    raise AssertionError(f"{len(made)} calls only")


def test_the_first_call_is_made_at_once() -> None:
    """As soon as there is an address there is an initiation."""
    pair = Pair(now=50.0)

    assert pair.a.node.next_deadline() == 50.0
    assert only(of(pair.a.timeout(50.0), Transmit)).path == AT_B


def test_waits_grow_from_the_first_to_the_longest_and_stay_there() -> None:
    """Waits begin with a quarter second, never shrink by more than the jitter, and stay below 2 s for ever."""
    times = [now for now, _ in calls(Pair(), 120)]
    waits = [later - earlier for earlier, later in pairwise(times)]

    assert all(c.RETRY_MIN_S <= wait < c.RETRY_MAX_S * (1 + c.RETRY_JITTER) < 2.0 for wait in waits)
    assert waits[0] < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)
    assert all(wait >= c.RETRY_MAX_S for wait in waits[-50:])
    assert all(later * (1 + c.RETRY_JITTER) > earlier for earlier, later in pairwise(waits))


def test_waits_are_not_all_the_same() -> None:
    """Jitter keeps two ends out of step."""
    times = [now for now, _ in calls(Pair(), 10)]

    assert len({round(later - earlier, 6) for earlier, later in pairwise(times)}) == 9


def test_a_peer_away_for_years_is_still_called() -> None:
    """The doubling is bounded before it is computed."""
    pair = Pair()
    pair.a.peer.caller._attempt = 10**9

    assert pair.a.peer.caller.call(None, 0, 5.0) is not None
    assert 5.0 + c.RETRY_MAX_S <= pair.a.peer.caller.retry_at < 7.0


def test_addresses_are_called_in_turn() -> None:
    """Each configured address is tried, the likeliest first, round and round."""
    pair = Pair()
    pair.a.node.set_addresses("bravo", [ELSEWHERE, OTHER, AT_B], 0.0)

    assert [out.path for _, out in calls(pair, 7)] == [ELSEWHERE, OTHER, AT_B, ELSEWHERE, OTHER, AT_B, ELSEWHERE]


def test_the_path_in_use_is_called_first_and_once() -> None:
    """Where the peer was heard comes before what the configuration says, and is not called twice a round."""
    pair = Pair()
    pair.a.node.set_addresses("bravo", [ELSEWHERE, AT_B], 0.0)

    assert pair.a.peer.caller.candidates(AT_B) == [AT_B, ELSEWHERE]
    assert pair.a.peer.caller.candidates(OTHER) == [OTHER, ELSEWHERE, AT_B]
    assert pair.a.peer.caller.candidates(None) == [ELSEWHERE, AT_B]


def test_without_an_address_nobody_is_called() -> None:
    """A peer of unknown address is waited for, without a timer."""
    pair = Pair()

    assert pair.b.timeout(0.0) == []
    assert pair.b.node.next_deadline() == float("inf")
    assert pair.b.peer.caller.call(None, 0, 0.0) is None


def test_an_address_that_becomes_known_is_called_at_once() -> None:
    """A name that resolves later starts the calls then."""
    pair = Pair()
    pair.b.timeout(0.0)
    pair.b.knows_the_way(30.0)

    assert pair.b.node.next_deadline() == 30.0
    assert datagrams(pair.b.timeout(30.0), wire.INITIATION)


def test_each_call_has_fresh_keys_and_index() -> None:
    """No two initiations share an ephemeral key or a session index."""
    made = [wire.parse_initiation(out.datagram) for _, out in calls(Pair(), 30)]

    assert len({each.ephemeral for each in made}) == 30
    assert len({each.sender_index for each in made}) == 30


def test_an_earlier_call_may_still_be_answered() -> None:
    """On a slow path the answer to the first call comes after the second: it makes the session all the same."""
    pair = Pair()
    (_, first), (_, second) = calls(pair, 2)
    answers = [only(datagrams(pair.b.receive(each.datagram, 1.0))) for each in (first, second)]

    outputs = pair.a.receive(answers[0], 1.0)

    assert of(outputs, SessionEstablished)
    pair.b.receive(only(datagrams(outputs)), 1.0)
    assert pair.carries(1.0)
    assert reasons(pair.a.receive(answers[1], 1.0)) == [DropReason.UNEXPECTED_RESPONSE]
    assert pair.carries(1.1)


def test_calls_that_may_be_answered_are_bounded() -> None:
    """The oldest is forgotten, and its answer is unexpected then."""
    pair = Pair()
    made = calls(pair, c.PENDING_PER_PEER + 1)
    now = made[-1][0]
    first, second = (only(datagrams(pair.b.receive(out.datagram, now))) for _, out in made[:2])

    assert len(pair.a.peer.caller.pending) == c.PENDING_PER_PEER
    assert reasons(pair.a.receive(first, now)) == [DropReason.UNEXPECTED_RESPONSE]
    assert of(pair.a.receive(second, now), SessionEstablished)


def test_a_call_may_be_answered_for_ten_seconds() -> None:
    """Just before its end an answer is taken, at the end it is not."""
    for late, expected in ((c.PENDING_LIFETIME_S - 0.001, True), (c.PENDING_LIFETIME_S, False)):
        pair = Pair()
        answer = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
        pair.a.peer.caller.expire(late)
        assert bool(of(pair.a.receive(answer, late), SessionEstablished)) is expected


def test_initiation_fails_softly_when_no_index_is_free() -> None:
    """With every index taken a call counts as lost, and the next comes after its wait."""
    pair = Pair()
    taken = Pair().establish().a.session
    pair.a.node._indices.owners.update(dict.fromkeys(range(2**16), taken))

    assert reasons(pair.a.timeout(0.0)) == [DropReason.NO_FREE_INDEX]
    assert 0.0 < pair.a.node.next_deadline() < 1.0
    pair.a.node._indices.owners.clear()
    assert datagrams(pair.a.timeout(pair.a.node.next_deadline()), wire.INITIATION)


def test_cookie_is_used_until_it_is_too_old() -> None:
    """A cookie goes into every handshake message for two minutes, not longer."""
    pair = Pair()
    initiation = pair.initiation(0.0)
    reply = pair.b.node._cookies.reply(initiation, wire.parse_initiation(initiation).sender_index, pair.a.at, 0.0)
    assert pair.a.receive(reply, 0.0) == []
    assert pair.a.peer.traffic.cookies_taken == 1

    caller = pair.a.peer.caller
    assert caller.add_macs(b"message", AT_B, c.COOKIE_HELD_S - 0.001)[-16:] != bytes(16)
    assert caller.add_macs(b"message", AT_B, c.COOKIE_HELD_S)[-16:] == bytes(16)


def test_cookies_of_two_paths_are_kept_apart() -> None:
    """A peer that we reach on IPv4 and IPv6 sees two addresses of ours, each with its cookie: both calls count."""
    pair = Pair()
    six: Path = (1, "2001:db8::2", 5790)
    from_six = (1, "2001:db8::1", 5790)
    pair.a.node.set_addresses("bravo", [AT_B, six], 0.0)
    jar = pair.b.node._cookies
    for now, call in calls(pair, 2):
        source = pair.a.at if call.path == AT_B else from_six
        index = wire.parse_initiation(call.datagram).sender_index
        assert not jar.has_valid_mac2(call.datagram, source, now)
        assert pair.a.receive(jar.reply(call.datagram, index, source, now), now) == []
    now = pair.a.node.next_deadline()
    for later, call in calls(pair, 2, now):
        assert jar.has_valid_mac2(call.datagram, pair.a.at if call.path == AT_B else from_six, later)


def test_few_cookies_are_held() -> None:
    """A name with many addresses, each of which gives one, costs no more than so many."""
    pair = Pair()
    many: list[Path] = [(0, f"198.51.100.{number}", 5790) for number in range(2 * c.COOKIES_PER_PEER)]
    pair.a.node.set_addresses("bravo", many, 0.0)
    jar = pair.b.node._cookies
    called: list[Path] = []
    now = 0.0
    for _ in many:
        now, call = calls(pair, 1, now)[0]
        index = wire.parse_initiation(call.datagram).sender_index
        assert pair.a.receive(jar.reply(call.datagram, index, pair.a.at, now), now) == []
        called.append(call.path)
        now = pair.a.node.next_deadline()
    assert len(set(called)) == len(many)
    assert list(pair.a.peer.caller._taken_cookies) == called[-c.COOKIES_PER_PEER :]


def test_cookies_do_not_make_calls_come_faster_than_the_first_wait() -> None:
    """Whoever sees our calls can make cookies; each brings one call a quarter second after the last, no more."""
    pair = Pair()
    now = calls(pair, 40)[-1][0]
    assert pair.a.peer.caller.retry_at >= now + c.RETRY_MAX_S
    index, pending = list(pair.a.peer.caller.pending.items())[-1]
    keys = pair.b.node._mac_keys
    for number in range(20):
        nonce = bytes((number,)) * 16
        forged = wire.encode_cookie_reply(index, nonce, keys.seal_cookie(bytes(16), nonce, pending.mac1))
        fate = [DropReason.UNEXPECTED_COOKIE] if number else []  # one is taken of each call
        assert reasons(pair.a.receive(forged, now + 0.01 * number)) == fate

    assert pair.a.node.next_deadline() == pytest.approx(now + c.RETRY_MIN_S)
    assert datagrams(pair.a.timeout(now + c.RETRY_MIN_S - 0.001), wire.INITIATION) == []
    assert len(datagrams(pair.a.timeout(now + c.RETRY_MIN_S), wire.INITIATION)) == 1


def test_forged_response_leaves_the_call_answerable() -> None:
    """A response altered anywhere, with its mac1 made right again, changes nothing; the genuine one completes."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    for position in range(len(response) - wire.MACS_BYTES):
        forged = repaired(flipped(response, position, position % 8), KEY_A.public)
        outputs = pair.a.receive(forged, 0.02 * position)
        assert len(reasons(outputs)) == 1
        assert datagrams(outputs) == []

    now = 0.02 * len(response)
    exchange(pair.b, pair.a, pair.a.receive(response, now), now)
    assert pair.carries(now)


def test_rest_begins_again_with_the_shortest_wait() -> None:
    """After a session was there, a lost peer is called as fast as at first."""
    pair = Pair(link_a=lively(retry_max_s=1.5))
    now = calls(pair, 60)[-1][0]
    pair.a.peer.caller.rest()

    (first, _), (second, _) = calls(pair, 2, pair.a.node.next_deadline())

    assert first > now
    assert second - first < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)


def test_repeated_calls_on_a_living_link_are_counted() -> None:
    """The first is no repetition, and a peer that is away is no living link."""
    pair = Pair(link_a=quiet(), link_b=quiet()).establish()
    counted = pair.a.peer.traffic
    calls(pair, 1, c.REKEY_AFTER_S)
    assert counted.handshakes_unanswered == 0
    calls(pair, 3, c.REKEY_AFTER_S + c.RETRY_MAX_S)
    assert counted.handshakes_unanswered == 3

    away = Pair()
    calls(away, 5)
    assert away.a.peer.traffic.handshakes_unanswered == 0


def test_calls_carry_macs_for_their_receiver() -> None:
    """An initiation has the mac1 that anyone can check who holds the receiver's public key, and no mac2."""
    pair = Pair()
    initiation = pair.initiation(0.0)

    assert initiation == with_macs(initiation[: -wire.MACS_BYTES], pair.b.node.public_key)
    assert Link().suites[0].number == initiation[1]
