"""Floods of initiations: what they may cost, and what is kept for peers at addresses where they are known to be."""

from __future__ import annotations

import pytest

from tests.core.harness import (
    AT_A,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    Pair,
    datagrams,
    exhaust,
    quiet,
    reasons,
    seeded,
    with_macs,
)
from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Output
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES_BY_NAME

COSTLY = Link(suites=(SUITES_BY_NAME["ffdhe2048"],))
UNITS = SUITES_BY_NAME["ffdhe2048"].work
ENTROPY = seeded(5)


def flooding(number: int) -> bytes:
    """A whole initiation that costs nothing to make: mac1 is valid, the Noise message is not."""
    size = wire.initiation_bytes(SUITES_BY_NAME["x25519"]) - wire.MACS_BYTES
    header = wire.initiation_header(SUITES_BY_NAME["x25519"], 1 + number % 65535)
    return with_macs(header + number.to_bytes(32, "big") + bytes(size - len(header) - 32), KEY_B.public)


def prefix(number: int) -> Path:
    """A host in a network of its own."""
    return Path(0, (f"10.{number // 256}.{number % 256}.7", 4000))


def initiation(pair: Pair, at: Path, now: float, link: Link = COSTLY, *, with_cookie: bool = False) -> list[Output]:
    """What bravo does about an initiation of alpha's from somewhere."""
    message = handshake.initiate(KEY_A, PeerSettings("bravo", KEY_B.public, None, link), 77, 0, ENTROPY).message
    plain = with_macs(message, KEY_B.public)
    if not with_cookie:
        return pair.b.receive(plain, now, at)
    reply = wire.parse_cookie_reply(pair.b.node._handshakes.own.cookies.reply(plain, 77, at, now))
    cookie = pair.b.node._handshakes.own.mac_keys.open_cookie(reply, plain[-wire.MACS_BYTES : -c.MAC_BYTES])
    return pair.b.receive(with_macs(message, KEY_B.public, cookie), now, at)


def established() -> Pair:
    """A link over a suite with a group; bravo was linked from alpha's place, and has no address for it."""
    link = quiet(suites=COSTLY.suites)
    return Pair(link_a=link, link_b=link).establish()


def spend_group_work(pair: Pair, now: float) -> None:
    """Use up what alpha may cost without a proof of where it is."""
    while pair.b.peer.group_share.anywhere.take(now, UNITS):
        pass


# Cookie replies.


def test_a_network_gets_so_many_cookies() -> None:
    """All hosts of a /24 share them; another network has its own."""
    pair = established()
    exhaust(pair.b, 1.0)
    sent = [reasons(pair.b.receive(flooding(n), 1.0, Path(0, (f"10.0.0.{n}", 9)))) for n in range(30)]

    assert sent.count([DropReason.COOKIE_REQUIRED]) == c.COOKIE_REPLIES_PER_PREFIX_BURST
    assert sent.count([DropReason.RATE_LIMITED]) == 30 - c.COOKIE_REPLIES_PER_PREFIX_BURST
    assert reasons(pair.b.receive(flooding(99), 1.0, Path(0, ("10.0.1.1", 9)))) == [DropReason.COOKIE_REQUIRED]


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
    assert fates.count([DropReason.BAD_HANDSHAKE]) <= c.INITIATIONS_PER_S
    exhaust(pair.b, 2.0)
    while pair.b.node._handshakes.admission._cookie_replies.take(2.0):
        pass
    assert reasons(initiation(pair, Path(0, ("10.99.0.1", 9)), 2.0)) == [DropReason.RATE_LIMITED]
    asked = initiation(pair, at, 2.0)
    assert reasons(asked) == [DropReason.COOKIE_REQUIRED]
    assert len(datagrams(asked, wire.COOKIE)) == 1
    assert datagrams(initiation(pair, at, 2.0, with_cookie=True), wire.RESPONSE)


def test_cookies_to_a_known_address_are_bounded_too() -> None:
    """One that forges exactly that address fills a slow radio by so many a second, and no more than any network's."""
    pair = established()
    exhaust(pair.b, 1.0)
    sent = [pair.b.receive(flooding(n), 1.0, AT_A) for n in range(80)]

    expected = c.COOKIE_REPLIES_PER_KNOWN_BURST + c.COOKIE_REPLIES_PER_PREFIX_BURST
    assert sum(len(datagrams(outputs, wire.COOKIE)) for outputs in sent) == expected


def test_only_so_many_initiations_are_read() -> None:
    """What is beyond is dropped before mac1, unless it comes from where a peer is known to be."""
    pair = established()
    unsealed = flooding(1)[: -wire.MACS_BYTES] + bytes(wire.MACS_BYTES)
    for number in range(c.INITIATIONS_READ_BURST):
        assert reasons(pair.b.receive(unsealed, 1.0, prefix(number))) == [DropReason.BAD_MAC1]

    assert reasons(pair.b.receive(unsealed, 1.0, ELSEWHERE)) == [DropReason.RATE_LIMITED]
    assert datagrams(initiation(pair, AT_A, 1.0), wire.RESPONSE)
    for _ in range(c.INITIATIONS_READ_PER_KNOWN_BURST - 1):
        assert reasons(pair.b.receive(unsealed, 1.0, AT_A)) == [DropReason.BAD_MAC1]
    assert reasons(pair.b.receive(unsealed, 1.0, AT_A)) == [DropReason.RATE_LIMITED]


# Group work.


def test_a_peer_may_cause_so_much_group_work() -> None:
    """Its initiations from many hosts, with cookies or without: the rest is refused before the group."""
    pair = established()
    expected = c.GROUP_WORK_PER_PEER_BURST // UNITS
    answered = 0
    for number in range(4 * expected):
        out = initiation(pair, prefix(number), 9.0 + number, with_cookie=number % 2 == 0)
        answered += len(datagrams(out, wire.RESPONSE))
        assert datagrams(out, wire.RESPONSE) or reasons(out) == [DropReason.GROUP_BUDGET_SPENT]

    refilled = 4 * expected * c.GROUP_WORK_PER_PEER_PER_S // UNITS
    assert answered <= expected + refilled
    assert pair.b.peer.traffic.drops[DropReason.GROUP_BUDGET_SPENT] == 4 * expected - answered


def test_a_suite_without_a_group_needs_no_budget() -> None:
    """X25519 is answered when the budget for group work is spent."""
    plain = quiet()
    pair = Pair(link_a=plain, link_b=plain).establish()
    spend_group_work(pair, 1.0)

    assert datagrams(initiation(pair, ELSEWHERE, 1.0, plain), wire.RESPONSE)


def test_a_peer_that_proves_where_it_is_has_a_reserve() -> None:
    """With a cookie for where it is known to be, it is answered; elsewhere no cookie helps."""
    pair = established()
    spend_group_work(pair, 9.0)

    assert reasons(initiation(pair, AT_A, 9.0)) == [DropReason.COOKIE_REQUIRED]
    assert reasons(initiation(pair, ELSEWHERE, 9.0, with_cookie=True)) == [DropReason.GROUP_BUDGET_SPENT]
    assert datagrams(initiation(pair, AT_A, 9.0, with_cookie=True), wire.RESPONSE)


def test_the_reserve_is_bounded() -> None:
    """A captured peer at its own address spends it, and no more."""
    pair = established()
    spend_group_work(pair, 9.0)
    while pair.b.peer.group_share.proven.take(9.0, UNITS):
        pass

    assert reasons(initiation(pair, AT_A, 9.0, with_cookie=True)) == [DropReason.GROUP_BUDGET_SPENT]
    assert datagrams(
        initiation(pair, AT_A, 9.0 + UNITS / c.GROUP_WORK_PER_PEER_PER_S, with_cookie=True), wire.RESPONSE
    )


def test_a_removed_peer_is_known_nowhere() -> None:
    """Its address has no share of its own any more."""
    pair = established()
    assert pair.b.node.claimed_sender(flooding(1), AT_A) == AT_A.address
    pair.b.node.remove_peer(pair.b.peer, 1.0)

    assert pair.b.node.claimed_sender(flooding(1), AT_A) is None


# Which sender a datagram belongs to, for a busy shell.


def test_senders_are_distinguished() -> None:
    """A peer where it is, the same peer elsewhere, a known address, and all others."""
    pair = established()
    node, envelope = pair.b.node, pair.a.envelope(1.0)

    assert node.claimed_sender(envelope, AT_A) == (pair.b.peer, True)
    assert node.claimed_sender(envelope, ELSEWHERE) == (pair.b.peer, False)
    assert node.claimed_sender(flooding(1), AT_A) == AT_A.address
    strangers = [flooding(1), b"", b"\x40", wire.envelope_header(0, 1) + bytes(20)]
    assert {node.claimed_sender(datagram, ELSEWHERE) for datagram in strangers} == {None}
