"""Connecting to a peer: how often and where initiations are sent, and which responses are still accepted."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.protocol.harness import AT_B, ELSEWHERE, Pair, datagrams, lively, of, only, reasons, with_macs
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import SessionEstablished, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link

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


# When.


def test_waits_grow_from_the_first_to_the_longest_and_stay_there() -> None:
    """They begin with a quarter second, stay below 2 s, and are not all the same. Years do not overflow them."""
    pair = Pair()
    waits = [later - earlier for (earlier, _), (later, _) in pairwise(initiations(pair, 120))]
    assert all(c.RETRY_MIN_S <= wait < c.RETRY_MAX_S * (1 + c.RETRY_JITTER) < 2.0 for wait in waits)
    assert waits[0] < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)
    assert all(wait >= c.RETRY_MAX_S for wait in waits[-50:])
    assert all(later * (1 + c.RETRY_JITTER) > earlier for earlier, later in pairwise(waits))
    assert len({round(wait, 6) for wait in waits[:9]}) == 9
    pair.a.peer.initiator.attempts = 10**9
    assert establish.initiate(pair.a.peer, 500.0)
    assert 500.0 + c.RETRY_MAX_S <= pair.a.peer.initiator.retry_at < 502.0
    pair.a.peer.initiator.attempts = 0
    (first, _), (second, _) = initiations(pair, 2, pair.a.node.next_deadline())
    assert second - first < c.RETRY_MIN_S * (1 + c.RETRY_JITTER)


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


# What.


def test_each_try_goes_along_every_address_with_fresh_keys_and_index() -> None:
    """The likeliest first. The datagrams of a try are equal, have the mac1 of their receiver, and no mac2."""
    pair = Pair()
    pair.a.node.set_paths(pair.a.peer, [ELSEWHERE, OTHER, AT_B], 0.0)
    made: list[wire.Initiation] = []
    for now in range(30):
        sent = of(pair.a.timeout(2.0 * now), Transmit)
        assert [out.path for out in sent] == [ELSEWHERE, OTHER, AT_B]
        (datagram,) = {out.datagram for out in sent}
        assert datagram == with_macs(datagram[: -wire.MACS_BYTES], pair.b.node.public_key)
        assert datagram[1] == Link().suites[0].number
        made.append(wire.parse_initiation(datagram))
    assert len({initiation.ephemeral for initiation in made}) == 30
    assert len({initiation.sender_index for initiation in made}) == 30


def test_initiation_fails_softly_when_no_index_is_free() -> None:
    """With every index in use an initiation counts as lost, and the next is sent after its wait."""
    pair = Pair()
    taken = pair.a.peer, Pair().establish().a.session
    pair.a.node._indices.owners.update(dict.fromkeys(range(2**16), taken))
    assert reasons(pair.a.timeout(0.0)) == [DropReason.NO_FREE_INDEX]
    assert 0.0 < pair.a.node.next_deadline() < 1.0
    pair.a.node._indices.owners.clear()
    assert datagrams(pair.a.timeout(pair.a.node.next_deadline()), wire.INITIATION)


# Responses.


def test_pending_initiations_are_limited_in_number_and_age() -> None:
    """The oldest is forgotten, and its answer is unexpected then. Just before its end an answer is taken."""
    pair = Pair()
    made = initiations(pair, c.PENDING_PER_PEER + 1)
    now = made[-1][0]
    first, second = (only(datagrams(pair.b.receive(out.datagram, now))) for _, out in made[:2])
    assert len(pair.a.peer.initiator.pending) == c.PENDING_PER_PEER
    assert reasons(pair.a.receive(first, now)) == [DropReason.UNEXPECTED_RESPONSE]
    assert of(pair.a.receive(second, now), SessionEstablished)
    for late, expected in ((c.PENDING_LIFETIME_S - 0.001, True), (c.PENDING_LIFETIME_S, False)):
        pair = Pair()
        answer = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
        pair.a.peer.initiator.expire(late)
        assert bool(of(pair.a.receive(answer, late), SessionEstablished)) is expected


# Cookies.


def test_cookie_is_used_until_it_is_too_old() -> None:
    """A cookie goes into every handshake message for two minutes, not longer."""
    pair = Pair()
    initiation = pair.initiation(0.0)
    index = wire.parse_initiation(initiation).sender_index
    assert pair.a.receive(pair.b.node._handshakes.cookies.reply(initiation, index, pair.a.at, 0.0), 0.0) == []
    assert pair.a.peer.traffic.cookies_taken == 1
    initiator = pair.a.peer.initiator
    assert initiator.add_macs(b"message", AT_B, c.COOKIE_HELD_S - 0.001)[-16:] != bytes(16)
    assert initiator.add_macs(b"message", AT_B, c.COOKIE_HELD_S)[-16:] == bytes(16)


def test_few_cookies_are_held() -> None:
    """Of a name with many addresses, each of which sends a cookie, only the newest few are held."""
    pair = Pair()
    many = [Path(number, (f"198.51.100.{number}", 5790)) for number in range(c.CONFIGURED_PATHS)]
    jar = pair.b.node._handshakes.cookies
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
    keys = pair.b.node._handshakes.cookies.keys
    for number in range(20):
        nonce = bytes((number,)) * 16
        forged = wire.encode_cookie_reply(index, nonce, keys.seal_cookie(bytes(16), nonce, pending.mac1))
        fate = [DropReason.UNEXPECTED_COOKIE] if number else []  # one is accepted per initiation
        assert reasons(pair.a.receive(forged, now + 0.01 * number)) == fate
    assert pair.a.peer.initiator.retry_at == pytest.approx(now + c.RETRY_MIN_S)
    assert datagrams(pair.a.timeout(now + c.RETRY_MIN_S - 0.001), wire.INITIATION) == []
    assert len(datagrams(pair.a.timeout(now + c.RETRY_MIN_S), wire.INITIATION)) == 1
