"""Floods of initiations: what they may cost, and what is kept for peers at addresses where they are known to be."""

from __future__ import annotations

from unittest.mock import patch

import pytest

from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    KEY_C,
    Pair,
    datagrams,
    exhaust,
    flipped,
    made_initiation,
    of,
    only,
    quiet,
    reasons,
    repaired,
    seeded,
    with_cookie,
    with_macs,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, SessionEstablished
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519

COSTLY = Link(suites=(SUITES_BY_NAME["ffdhe2048"],))
UNITS = SUITES_BY_NAME["ffdhe2048"].work
PLAIN = quiet()


def flooding(number: int) -> bytes:
    """A whole initiation that costs nothing to make: mac1 is valid, the Noise message is not."""
    size = wire.initiation_bytes(SUITES_BY_NAME["x25519"]) - wire.MACS_BYTES
    header = wire.initiation_header(SUITES_BY_NAME["x25519"], 1 + number % 65535)
    return with_macs(header + number.to_bytes(32, "big") + bytes(size - len(header) - 32), KEY_B.public)


def prefix(number: int) -> Path:
    """A host in a network of its own."""
    return Path(0, (f"10.{number // 256}.{number % 256}.7", 4000))


def initiation(
    pair: Pair, at: Path, now: float, link: Link = COSTLY, key: KeyPair = KEY_A, *, cookie: bool = False
) -> list[Output]:
    """What bravo does about an initiation from somewhere, of alpha by default."""
    made = made_initiation(key, link=link)
    return pair.b.receive(with_cookie(pair.b, made, at, now) if cookie else made, now, at)


def established(link: Link = COSTLY) -> Pair:
    """A link, by default with a group; bravo was linked from alpha's place, and has no address for it."""
    link = quiet(suites=link.suites)
    return Pair(link_a=link, link_b=link).establish()


def spend(bucket: TokenBucket, now: float, units: float = 1.0) -> None:
    """Use up a bucket."""
    while bucket.take(now, units):
        pass


# Key exchanges.


def test_budget_of_key_exchanges_refills_and_responses_have_their_own() -> None:
    """Fifty messages at once may cost key exchanges, then fifty a second. A flood leaves our own handshakes alone."""
    pair = established(PLAIN)
    forged = [repaired(flipped(made_initiation(), 60), KEY_B.public) for _ in range(3)]
    for _ in range(c.INITIATIONS.burst):
        assert reasons(pair.b.receive(forged[0], 9.0)) == [DropReason.BAD_HANDSHAKE]
    assert reasons(pair.b.receive(forged[1], 9.0)) == [DropReason.COOKIE_REQUIRED]
    refilled = 9.0 + 1.001 / c.INITIATIONS.per_s
    assert reasons(pair.b.receive(forged[2], refilled)) == [DropReason.BAD_HANDSHAKE]
    pair = Pair(PLAIN, PLAIN)
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    spend(pair.a.node._handshakes.admission._initiations, 0.0)
    assert of(pair.a.receive(response, 0.0), SessionEstablished)


def test_one_source_has_its_share_under_load() -> None:
    """Ten a second with a cookie. Another source, also behind the same router, has its own: so a peer is answered."""
    pair = established(PLAIN)
    exhaust(pair.b, 1.0)
    host, port = AT_A.host, AT_A.address[1]
    pair.b.node.set_paths(pair.b.peer, [Path(0, (host, port + 1))], 1.0)
    for place in (AT_A, Path(0, (host, port + 2))):
        fates = [
            reasons(initiation(pair, place, 1.0, PLAIN, KEY_C, cookie=True))
            for _ in range(c.COOKIED_PER_SOURCE.burst + 1)
        ]
        assert fates == [[DropReason.UNKNOWN_PEER]] * c.COOKIED_PER_SOURCE.burst + [[DropReason.RATE_LIMITED]]
    for place in (Path(0, (host, port + 1)), ELSEWHERE):
        assert datagrams(initiation(pair, place, 1.0, PLAIN, cookie=True), wire.RESPONSE)


@pytest.mark.parametrize("known_by", ["its path", "its configured address"])
def test_all_sources_together_have_a_bound(monkeypatch: pytest.MonkeyPatch, known_by: str) -> None:
    """An attacker with many addresses, and a cookie for each, causes a bounded number of key exchanges.

    A peer at its configured address, or at its last known one, does not queue with the attacker.
    """
    pair = established(PLAIN) if known_by == "its path" else Pair(link_a=PLAIN, link_b=PLAIN)
    node = pair.b.node
    monkeypatch.setattr(node._handshakes.cookies, "has_valid_mac2", lambda *_: True)
    spend(node._handshakes.admission._initiations, 1.0)
    fates = [
        reasons(node.receive(made_initiation(KEY_C), Path(0, (f"10.0.{number // 200}.{number % 200}", 1)), 1.0))
        for number in range(int(c.COOKIED_PER_S) + 5)
    ]
    assert fates.count([DropReason.UNKNOWN_PEER]) == c.COOKIED_PER_S
    assert fates.count([DropReason.RATE_LIMITED]) == 5
    assert reasons(pair.b.receive(made_initiation(), 1.0, ELSEWHERE)) == [DropReason.RATE_LIMITED]
    if known_by == "its configured address":
        assert reasons(pair.b.receive(made_initiation(), 1.0)) == [DropReason.RATE_LIMITED]
        node.set_paths(pair.b.peer, [AT_A], 1.0)
    assert datagrams(pair.b.receive(made_initiation(), 1.0), wire.RESPONSE)


# Answers.


@pytest.mark.parametrize("is_up", [False, True])
def test_answers_to_one_peer_are_bounded(is_up: bool) -> None:
    """A burst is answered at once; after that two a second without a cookie.

    Recorded initiations may use them up: the peer itself gets one with a cookie, and not without bound.
    """
    pair = established(PLAIN) if is_up else Pair(link_a=PLAIN, link_b=PLAIN)
    rate, now = c.ANSWERS.per_s, 10.0
    for _ in range(c.ANSWERS.burst):
        assert datagrams(pair.b.receive(made_initiation(), now), wire.RESPONSE)
    for moment in (now, now + 1 / rate - 0.001):
        outputs = pair.b.receive(made_initiation(), moment)
        assert reasons(outputs) == [DropReason.COOKIE_REQUIRED]
        assert datagrams(outputs, wire.RESPONSE) == []
    now += 1 / rate
    assert datagrams(pair.b.receive(made_initiation(), now), wire.RESPONSE)
    fates = [initiation(pair, prefix(number), now, PLAIN, cookie=True) for number in range(40)]
    assert sum(len(datagrams(outputs, wire.RESPONSE)) for outputs in fates) == c.COOKIED_ANSWERS_PER_S


# Cookie replies.


def test_a_network_gets_so_many_cookies() -> None:
    """All hosts of a /24 share them; another network has its own, and so has a known address."""
    pair = established()
    exhaust(pair.b, 1.0)
    sent = [reasons(pair.b.receive(flooding(n), 1.0, Path(0, (f"10.0.0.{n}", 9)))) for n in range(30)]
    assert sent.count([DropReason.COOKIE_REQUIRED]) == c.COOKIE_REPLIES_PER_PREFIX.burst
    assert sent.count([DropReason.RATE_LIMITED]) == 30 - c.COOKIE_REPLIES_PER_PREFIX.burst
    assert reasons(pair.b.receive(flooding(99), 1.0, Path(0, ("10.0.1.1", 9)))) == [DropReason.COOKIE_REQUIRED]
    known = [pair.b.receive(flooding(n), 1.0, AT_A) for n in range(80)]
    expected = c.COOKIE_REPLIES_PER_KNOWN.burst + c.COOKIE_REPLIES_PER_PREFIX.burst
    assert sum(len(datagrams(outputs, wire.COOKIE)) for outputs in known) == expected


@pytest.mark.parametrize("known_by", ["where it was last seen", "its configured address"])
def test_a_flood_from_ten_thousand_networks_leaves_a_known_peer_its_cookie(known_by: str) -> None:
    """The flood is sent a bounded number; the peer is sent its own, and with it gets its session."""
    pair = established()
    at = AT_A
    if known_by == "its configured address":
        at = Path(0, ("192.0.2.77", 5790))
        pair.b.node.set_paths(pair.b.peer, [at], 0.5)
    exhaust(pair.b, 1.0)
    fates = [reasons(pair.b.receive(flooding(n), 1.0 + n / 10_000, prefix(n))) for n in range(10_000)]
    # The flood had the first second's budget too, and one more of the messages that need no cookie.
    assert fates.count([DropReason.COOKIE_REQUIRED]) <= 2 * c.COOKIE_REPLIES_PER_S
    assert fates.count([DropReason.BAD_HANDSHAKE]) <= c.INITIATIONS.per_s
    exhaust(pair.b, 2.0)
    spend(pair.b.node._handshakes.admission._cookie_replies, 2.0)
    assert reasons(initiation(pair, Path(0, ("10.99.0.1", 9)), 2.0)) == [DropReason.RATE_LIMITED]
    asked = initiation(pair, at, 2.0)
    assert reasons(asked) == [DropReason.COOKIE_REQUIRED]
    assert len(datagrams(asked, wire.COOKIE)) == 1
    assert datagrams(initiation(pair, at, 2.0, cookie=True), wire.RESPONSE)


def test_only_so_many_initiations_are_read() -> None:
    """What is beyond is dropped before mac1, unless it comes from where a peer is known to be."""
    pair = established()
    unsealed = flooding(1)[: -wire.MACS_BYTES] + bytes(wire.MACS_BYTES)
    for number in range(c.INITIATIONS_READ.burst):
        assert reasons(pair.b.receive(unsealed, 1.0, prefix(number))) == [DropReason.BAD_MAC1]
    assert reasons(pair.b.receive(unsealed, 1.0, ELSEWHERE)) == [DropReason.RATE_LIMITED]
    assert datagrams(initiation(pair, AT_A, 1.0), wire.RESPONSE)
    for _ in range(c.INITIATIONS_READ_PER_KNOWN.burst - 1):
        assert reasons(pair.b.receive(unsealed, 1.0, AT_A)) == [DropReason.BAD_MAC1]
    assert reasons(pair.b.receive(unsealed, 1.0, AT_A)) == [DropReason.RATE_LIMITED]


# Group work.


def test_a_peer_that_proves_where_it_is_has_a_bounded_reserve() -> None:
    """With a cookie for where it is known to be, it is answered; elsewhere no cookie helps. X25519 needs none."""
    pair = established()
    spend(pair.b.peer.group_work, 9.0, UNITS)
    assert reasons(initiation(pair, AT_A, 9.0)) == [DropReason.COOKIE_REQUIRED]
    assert reasons(initiation(pair, ELSEWHERE, 9.0, cookie=True)) == [DropReason.GROUP_BUDGET_SPENT]
    assert datagrams(initiation(pair, AT_A, 9.0, cookie=True), wire.RESPONSE)
    spend(pair.b.peer.proven_group_work, 9.0, UNITS)
    assert reasons(initiation(pair, AT_A, 9.0, cookie=True)) == [DropReason.GROUP_BUDGET_SPENT]
    refilled = 9.0 + UNITS / c.GROUP_WORK_PER_PEER.per_s
    assert datagrams(initiation(pair, AT_A, refilled, cookie=True), wire.RESPONSE)
    pair = established(PLAIN)
    spend(pair.b.peer.group_work, 1.0, UNITS)
    assert datagrams(initiation(pair, ELSEWHERE, 1.0, PLAIN), wire.RESPONSE)


# Which sender a datagram belongs to, for a busy shell.


def test_senders_are_distinguished() -> None:
    """A peer where it is, the same peer elsewhere, a known address, and all others, such as a removed peer."""
    pair = established()
    node, envelope = pair.b.node, pair.a.envelope(1.0)
    assert node.claimed_sender(envelope, AT_A) == (pair.b.peer, True)
    assert node.claimed_sender(envelope, ELSEWHERE) == (pair.b.peer, False)
    assert node.claimed_sender(flooding(1), AT_A) == AT_A.address
    strangers = [flooding(1), b"", b"\x40", wire.envelope_header(0, 1) + bytes(20)]
    assert {node.claimed_sender(datagram, ELSEWHERE) for datagram in strangers} == {None}
    node.remove_peer(pair.b.peer, 1.0)
    assert node.claimed_sender(flooding(1), AT_A) is None


def test_newer_initiation_supersedes_one_for_the_same_key_along_the_same_path_only() -> None:
    """A forgery without the cookie, another path and a response supersede nothing."""
    pair = Pair()
    node, initiation = pair.b.node, pair.initiation(0.0)
    index = wire.parse_initiation(initiation).sender_index
    pair.a.receive(node._handshakes.cookies.reply(initiation, index, AT_A, 0.0), 0.0)
    proven = pair.initiation(pair.a.node.next_deadline())
    first, newer, with_cookie = (node.handshake_source(one, AT_A, 0.0) for one in (flooding(1), flooding(2), proven))
    assert first == newer != with_cookie
    assert [first, with_cookie] == node.initiations_from(AT_A)
    response = only(datagrams(node.receive(initiation, AT_A, 0.0), wire.RESPONSE))
    assert pair.a.node.handshake_source(response, AT_B, 0.0) == (AT_B, response)
    assert node.handshake_source(flooding(1), ELSEWHERE, 0.0) not in (None, first)
    assert node.handshake_source(b"\3", AT_A, 0.0) is None


def test_only_what_passes_the_screen_may_wait() -> None:
    """An initiation spends one token, and no hash without it. A response that nothing awaits costs no hash either."""
    node = Pair().b.node
    forged = flooding(1)[: -wire.MACS_BYTES] + bytes(wire.MACS_BYTES)
    response = wire.response_header(X25519, 1, 2).ljust(wire.response_bytes(X25519), b"1")
    garbage = (forged, b"\1", b"\2", b"", response)
    drops = [node.screen(one, ELSEWHERE, 0.0) for one in garbage]
    assert [drop and drop.reason for drop in drops] == ["bad_mac1", *["malformed"] * 3, "unexpected_response"]
    initiations = [flooding(number) for number in range(1, c.INITIATIONS_READ.burst - 1)]
    assert [node.screen(one, ELSEWHERE, 0.0) for one in initiations] == [None] * len(initiations)
    with patch.object(MacKeys, "has_valid_mac1", lambda *_: pytest.fail("a hash beyond the budget")):
        drop = node.screen(flooding(1), ELSEWHERE, 0.0)
        assert drop is not None
        assert drop.reason == "rate_limited"
        assert reasons(node.receive(flooding(1), ELSEWHERE, 0.0)) == ["rate_limited"]
        assert "rate_limited" not in reasons(node.receive(initiations[0], ELSEWHERE, 0.0, is_screened=True))


# A daemon with many peers, such as a relay, starts again: all of them initiate at once.


@pytest.mark.parametrize(("peers", "expected"), [(1, 50), (25, 50), (26, 52), (1001, 2000)])
def test_burst_grows_with_the_peers_and_is_bounded(peers: int, expected: int) -> None:
    """It shrinks with them too."""
    node = Node(Secret(bytes([200]) * 32), seeded(0), 0.0)
    added = [
        node.add_peer(PeerSettings(f"m{number}", KeyPair(number.to_bytes(2, "big") * 16).public), 0.0)
        for number in range(1, peers + 1)
    ]
    bucket = node._handshakes.admission._initiations
    assert bucket.has(0.0, expected)
    assert not bucket.has(0.0, expected + 1)
    for peer in added:
        node.remove_peer(peer, 0.0)
    assert not bucket.has(0.0, c.INITIATIONS.burst + 1)


def test_burst_is_there_for_peers_that_may_come_by_certificate() -> None:
    """A daemon that starts knows none of them. Those that came are among them."""
    node = Node(Secret(bytes([200]) * 32), seeded(0), 0.0, most_admitted=256)
    node.add_peer(PeerSettings("m1", KeyPair(bytes([1]) * 32).public), 0.0)
    bucket = node._handshakes.admission._initiations
    assert bucket.has(0.0, 512)
    assert not bucket.has(0.0, 513)
