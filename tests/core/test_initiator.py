"""Connecting to a peer: how often and where initiations are sent, and which responses are still accepted."""

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
from uavlinkd.core import establish, wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link

OTHER = Path(1, ("203.0.113.5", 14600))


def initiations(pair: Pair, count: int, start: float = 0.0) -> list[tuple[float, Transmit]]:
    """Alpha's next ``count`` initiations, and the time of each."""
    made: list[tuple[float, Transmit]] = []
    now = start
    for _ in range(20 * count):
        made += [(now, out) for out in of(pair.a.timeout(now), Transmit) if out.datagram[0] == wire.INITIATION]
        if len(made) >= count:
            return made
        now = pair.a.node.next_deadline()
    raise AssertionError(f"{len(made)} initiations only")


def test_first_initiation_is_sent_at_once() -> None:
    """As soon as there is an address there is an initiation."""
    pair = Pair(now=50.0)

    assert pair.a.node.next_deadline() == 50.0
    assert only(of(pair.a.timeout(50.0), Transmit)).path == AT_B


def test_waits_grow_from_the_first_to_the_longest_and_stay_there() -> None:
    """Waits begin with a quarter second, never shrink by more than the jitter, and always stay below 2 s."""
    times = [now for now, _ in initiations(Pair(), 120)]
    waits = [later - earlier for earlier, later in pairwise(times)]

    assert all(c.RETRY_MIN_S <= wait < c.RETRY_MAX_S * (1 + c.RETRY_JITTER) < 2.0 for wait in waits)
    assert waits[0] < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)
    assert all(wait >= c.RETRY_MAX_S for wait in waits[-50:])
    assert all(later * (1 + c.RETRY_JITTER) > earlier for earlier, later in pairwise(waits))


def test_waits_are_not_all_the_same() -> None:
    """Jitter keeps two ends out of step."""
    times = [now for now, _ in initiations(Pair(), 10)]

    assert len({round(later - earlier, 6) for earlier, later in pairwise(times)}) == 9


def test_peer_away_for_years_still_gets_initiations() -> None:
    """The doubling is bounded before it is computed."""
    pair = Pair()
    pair.a.peer.initiator.attempts = 10**9

    assert establish.initiate(pair.a.peer, 5.0)
    assert 5.0 + c.RETRY_MAX_S <= pair.a.peer.initiator.retry_at < 7.0


def test_each_try_goes_along_every_address() -> None:
    """The likeliest first. The datagrams are equal, and only the first is not a copy."""
    pair = Pair()
    pair.a.node.set_paths(pair.a.peer, [ELSEWHERE, OTHER, AT_B], 0.0)

    for now in (0.0, 0.5):
        sent = of(pair.a.timeout(now), Transmit)
        assert [(out.path, out.is_copy) for out in sent] == [(ELSEWHERE, False), (OTHER, True), (AT_B, True)]
        assert len({out.datagram for out in sent}) == 1


def test_no_initiation_without_an_address() -> None:
    """A peer of unknown address is waited for, without a timer."""
    pair = Pair()

    assert pair.b.timeout(0.0) == []
    assert pair.b.node.next_deadline() == float("inf")
    assert establish.initiate(pair.b.peer, 0.0) == []


def test_new_address_gets_an_initiation_at_once() -> None:
    """Initiations start when the peer's name resolves."""
    pair = Pair()
    pair.b.timeout(0.0)
    pair.b.configure_path(30.0)

    assert pair.b.node.next_deadline() <= 30.0
    assert datagrams(pair.b.timeout(30.0), wire.INITIATION)


def test_each_initiation_has_fresh_keys_and_index() -> None:
    """No two initiations share an ephemeral key or a session index."""
    made = [wire.parse_initiation(out.datagram) for _, out in initiations(Pair(), 30)]

    assert len({initiation.ephemeral for initiation in made}) == 30
    assert len({initiation.sender_index for initiation in made}) == 30


def test_earlier_initiation_may_still_be_answered() -> None:
    """On a slow path the response to the first initiation arrives after the second. It still makes the session."""
    pair = Pair()
    (_, first), (_, second) = initiations(pair, 2)
    answers = [only(datagrams(pair.b.receive(initiation.datagram, 1.0))) for initiation in (first, second)]

    outputs = pair.a.receive(answers[0], 1.0)

    assert of(outputs, SessionEstablished)
    pair.b.receive(only(datagrams(outputs)), 1.0)
    assert pair.carries(1.0)
    assert reasons(pair.a.receive(answers[1], 1.0)) == [DropReason.UNEXPECTED_RESPONSE]
    assert pair.carries(1.1)


def test_pending_initiations_are_bounded() -> None:
    """The oldest is forgotten, and its answer is unexpected then."""
    pair = Pair()
    made = initiations(pair, c.PENDING_PER_PEER + 1)
    now = made[-1][0]
    first, second = (only(datagrams(pair.b.receive(out.datagram, now))) for _, out in made[:2])

    assert len(pair.a.peer.initiator.pending) == c.PENDING_PER_PEER
    assert reasons(pair.a.receive(first, now)) == [DropReason.UNEXPECTED_RESPONSE]
    assert of(pair.a.receive(second, now), SessionEstablished)


def test_initiation_may_be_answered_for_ten_seconds() -> None:
    """Just before its end an answer is taken, at the end it is not."""
    for late, expected in ((c.PENDING_LIFETIME_S - 0.001, True), (c.PENDING_LIFETIME_S, False)):
        pair = Pair()
        answer = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
        pair.a.peer.initiator.expire(late)
        assert bool(of(pair.a.receive(answer, late), SessionEstablished)) is expected


def test_initiation_fails_softly_when_no_index_is_free() -> None:
    """With every index in use an initiation counts as lost, and the next is sent after its wait."""
    pair = Pair()
    taken = pair.a.peer, Pair().establish().a.session
    pair.a.node._indices.owners.update(dict.fromkeys(range(2**16), taken))

    assert reasons(pair.a.timeout(0.0)) == [DropReason.NO_FREE_INDEX]
    assert 0.0 < pair.a.node.next_deadline() < 1.0
    pair.a.node._indices.owners.clear()
    assert datagrams(pair.a.timeout(pair.a.node.next_deadline()), wire.INITIATION)


def test_cookie_is_used_until_it_is_too_old() -> None:
    """A cookie goes into every handshake message for two minutes, not longer."""
    pair = Pair()
    initiation = pair.initiation(0.0)
    reply = pair.b.node._handshakes.own.cookies.reply(
        initiation, wire.parse_initiation(initiation).sender_index, pair.a.at, 0.0
    )
    assert pair.a.receive(reply, 0.0) == []
    assert pair.a.peer.traffic.cookies_taken == 1

    initiator = pair.a.peer.initiator
    assert initiator.add_macs(b"message", AT_B, c.COOKIE_HELD_S - 0.001)[-16:] != bytes(16)
    assert initiator.add_macs(b"message", AT_B, c.COOKIE_HELD_S)[-16:] == bytes(16)


def test_cookies_of_two_paths_are_kept_apart() -> None:
    """A peer that we reach on IPv4 and IPv6 sees two addresses of ours and sends a cookie for each. Both are used."""
    pair = Pair()
    six = Path(1, ("2001:db8::2", 5790, 0, 0))
    from_six = Path(1, ("2001:db8::1", 5790, 0, 0))
    pair.a.node.set_paths(pair.a.peer, [AT_B, six], 0.0)
    jar = pair.b.node._handshakes.own.cookies
    for now, initiation in initiations(pair, 2):
        assert now == 0.0
        source = pair.a.at if initiation.path == AT_B else from_six
        index = wire.parse_initiation(initiation.datagram).sender_index
        assert not jar.has_valid_mac2(initiation.datagram, source, now)
        assert pair.a.receive(jar.reply(initiation.datagram, index, source, now), now, initiation.path) == []
    now = pair.a.node.next_deadline()
    for later, initiation in initiations(pair, 2, now):
        assert jar.has_valid_mac2(initiation.datagram, pair.a.at if initiation.path == AT_B else from_six, later)


def test_few_cookies_are_held() -> None:
    """Of a name with many addresses, each of which sends a cookie, only the newest few are held."""
    pair = Pair()
    many = [Path(number, (f"198.51.100.{number}", 5790)) for number in range(c.CONFIGURED_PATHS)]
    jar = pair.b.node._handshakes.own.cookies
    sent: dict[Path, Transmit] = {}
    for number in range(c.CONFIGURED_PATHS + 1):  # the peer moves: its first address has another port now
        paths = [Path(0, ("198.51.100.0", 5791)), *many[1:]] if number == c.CONFIGURED_PATHS else many
        pair.a.node.set_paths(pair.a.peer, paths, 0.3 * number)
        sent = {out.path: out for out in of(pair.a.timeout(0.3 * number), Transmit)}
        path = paths[number % c.CONFIGURED_PATHS]
        index = wire.parse_initiation(sent[path].datagram).sender_index
        assert pair.a.receive(jar.reply(sent[path].datagram, index, pair.a.at, 0.0), 0.3 * number, path) == []
    pair.a.node.set_paths(pair.a.peer, many, 3.0)
    proven = [out.path for out in of(pair.a.timeout(3.0), Transmit) if out.datagram[-16:] != bytes(16)]
    assert proven == many[1:]


def test_cookies_do_not_shorten_the_first_wait() -> None:
    """An observer of our initiations can make cookies. A cookie causes one initiation, 0.25 s after the last."""
    pair = Pair()
    now = initiations(pair, 40)[-1][0]
    assert pair.a.peer.initiator.retry_at >= now + c.RETRY_MAX_S
    index, pending = list(pair.a.peer.initiator.pending.items())[-1]
    keys = pair.b.node._handshakes.own.mac_keys
    for number in range(20):
        nonce = bytes((number,)) * 16
        forged = wire.encode_cookie_reply(index, nonce, keys.seal_cookie(bytes(16), nonce, pending.mac1))
        fate = [DropReason.UNEXPECTED_COOKIE] if number else []  # one is accepted per initiation
        assert reasons(pair.a.receive(forged, now + 0.01 * number)) == fate

    assert pair.a.node.next_deadline() == pytest.approx(now + c.RETRY_MIN_S)
    assert datagrams(pair.a.timeout(now + c.RETRY_MIN_S - 0.001), wire.INITIATION) == []
    assert len(datagrams(pair.a.timeout(now + c.RETRY_MIN_S), wire.INITIATION)) == 1


def test_forged_response_leaves_the_initiation_pending() -> None:
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


def test_reset_restores_the_shortest_wait() -> None:
    """After a session, initiations to a lost peer are sent as fast as at first."""
    pair = Pair(link_a=lively(retry_max_s=1.5))
    now = initiations(pair, 60)[-1][0]
    pair.a.peer.initiator.reset()

    (first, _), (second, _) = initiations(pair, 2, pair.a.node.next_deadline())

    assert first > now
    assert second - first < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)


def test_repeated_initiations_on_a_link_that_is_up_are_counted() -> None:
    """The first one is not counted as repeated, nor are those to a peer that is not up."""
    pair = Pair(link_a=quiet(), link_b=quiet()).establish()
    counted = pair.a.peer.traffic
    initiations(pair, 1, c.REKEY_AFTER_S)
    assert counted.handshakes_unanswered == 0
    initiations(pair, 3, c.REKEY_AFTER_S + c.RETRY_MAX_S)
    assert counted.handshakes_unanswered == 3

    away = Pair()
    initiations(away, 5)
    assert away.a.peer.traffic.handshakes_unanswered == 0


def test_initiations_have_macs_for_their_receiver() -> None:
    """An initiation has the mac1 that anyone can check who holds the receiver's public key, and no mac2."""
    pair = Pair()
    initiation = pair.initiation(0.0)

    assert initiation == with_macs(initiation[: -wire.MACS_BYTES], pair.b.node.public_key)
    assert Link().suites[0].number == initiation[1]


def test_first_wait_is_short_again_when_the_peer_was_received_meanwhile() -> None:
    """Even if the peer is silent again before the next initiation would have been due."""
    pair = Pair(lively(retry_max_s=10.0, lost_after_s=1000.0), lively()).establish()
    pair.a.send(0.0)
    assert datagrams(pair.a.timeout(1.0), wire.INITIATION), "the frame was not answered"
    pair.a.peer.initiator.attempts = 60
    assert datagrams(pair.a.timeout(1.5), wire.INITIATION)
    assert pair.a.peer.initiator.retry_at > 9.0
    pair.a.receive(pair.b.envelope(1.6), 1.6)
    pair.a.send(1.7)
    pair.a.timeout(2.7)
    assert datagrams(pair.a.timeout(15.0), wire.INITIATION)
    assert pair.a.peer.initiator.attempts == 1
