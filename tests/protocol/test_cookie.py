"""mac1, mac2 and cookies: who may cost us a key exchange. Initiations of other versions, which mac1 tells apart."""

from __future__ import annotations

import pytest

from tests.protocol.harness import (
    AT_A,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    Pair,
    flipped,
    initiation_of,
    reasons,
    seeded,
    state_of,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.cookie import OTHERS, CookieJar, MacKeys, mac1_of, version_of
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.outputs import Dropped
from uavlinkd.protocol.path import Path

KEYS = MacKeys(KEY_B.public)
MESSAGE = b"\1\0\0\7" + bytes(range(100))
LIFETIME = c.COOKIE_SECRET_LIFETIME_S


def cookie_from(jar: CookieJar, now: float, path: Path = AT_A) -> bytes:
    """The cookie that the jar gives to a sender, opened as the sender opens it."""
    datagram = KEYS.add_macs(MESSAGE, None)
    reply = wire.parse_cookie_reply(jar.reply(datagram, 7, path, now))
    assert reply.receiver_index == 7
    return KEYS.open_cookie(reply, mac1_of(datagram))


@pytest.fixture
def jar() -> CookieJar:
    """The responder's jar, opened at 1000 s."""
    return CookieJar(KEYS, seeded(1), 1000.0)


def test_cookie_admits_its_source_over_any_message(jar: CookieJar) -> None:
    """A bit turned over in any byte, mac2's own included, and the cookie does not count."""
    cookie = cookie_from(jar, 1000.0)
    datagram = KEYS.add_macs(MESSAGE, cookie)
    assert jar.has_valid_mac2(datagram, AT_A, 1000.0)
    assert jar.has_valid_mac2(KEYS.add_macs(b"other" + MESSAGE, cookie), AT_A, 1001.0)
    for position in range(len(datagram)):
        assert not jar.has_valid_mac2(flipped(datagram, position, position % 8), AT_A, 1000.0)
    assert not jar.has_valid_mac2(KEYS.add_macs(MESSAGE, None), AT_A, 1000.0)


@pytest.mark.parametrize("given", [1000.0, 1000.0 + LIFETIME / 2, 1000.0 + LIFETIME - 0.001])
@pytest.mark.parametrize("asked_at", [0.0, LIFETIME, 2 * LIFETIME - 1.0])
def test_cookie_lives_between_one_and_two_lifetimes(jar: CookieJar, given: float, asked_at: float) -> None:
    """It is honoured until the secret after its own ends, whether or not and whenever anyone asked in between."""
    datagram = KEYS.add_macs(MESSAGE, cookie_from(jar, given))
    end = 1000.0 + 2 * LIFETIME
    assert jar.has_valid_mac2(datagram, AT_A, max(given, 1000.0 + asked_at))
    assert jar.has_valid_mac2(datagram, AT_A, end - 0.001)
    assert not jar.has_valid_mac2(datagram, AT_A, end)
    late = CookieJar(KEYS, seeded(1), 1000.0)
    datagram = KEYS.add_macs(MESSAGE, cookie_from(late, given))
    assert not late.has_valid_mac2(datagram, AT_A, 1000.0 + 10 * LIFETIME), "a long silence ends both secrets"


def test_sealed_cookie_opens_for_the_asker_alone(jar: CookieJar) -> None:
    """A cookie is bound to the message that asked for it and to the responder's key. Each reply has a fresh nonce."""
    datagram = KEYS.add_macs(MESSAGE, None)
    raw, again = (jar.reply(datagram, 7, AT_A, 1000.0) for _ in range(2))
    other_mac1 = mac1_of(KEYS.add_macs(b"other" + MESSAGE, None))
    reply = wire.parse_cookie_reply(raw)
    assert reply.nonce != wire.parse_cookie_reply(again).nonce
    attempts = [(KEYS, reply, other_mac1), (MacKeys(KEY_A.public), reply, mac1_of(datagram))]
    attempts += [
        (KEYS, wire.parse_cookie_reply(flipped(raw, position)), mac1_of(datagram)) for position in range(4, len(raw))
    ]
    for keys, altered, mac1 in attempts:
        with pytest.raises(Drop) as caught:
            keys.open_cookie(altered, mac1)
        assert caught.value.reason is DropReason.BAD_COOKIE
    assert len(KEYS.open_cookie(reply, mac1_of(datagram))) == c.MAC_BYTES


# Other versions: named, never answered, and at no cost that a flood could raise.


@pytest.mark.parametrize("length", [147, wire.MACS_BYTES + 1, 900, c.VERSION_CHECK_BYTES])
@pytest.mark.parametrize("version", OTHERS)
def test_other_version_is_named_and_not_answered(version: int, length: int) -> None:
    """The drop has the version, whatever the length of the message. No datagram goes out, and no state changes."""
    pair = Pair().establish()
    before = state_of(pair.b.node)
    outputs = pair.b.receive(initiation_of(version, KEY_B.public, length), 1.0, ELSEWHERE)
    assert outputs == [Dropped(DropReason.OTHER_VERSION, None, ELSEWHERE, 1, version)]
    assert state_of(pair.b.node) == before
    assert pair.b.node.drops == {DropReason.OTHER_VERSION: 1}


@pytest.mark.parametrize(
    "message",
    [
        pytest.param(initiation_of(1, KEY_A.public), id="for another key"),
        pytest.param(initiation_of(c.LAST_KNOWN_VERSION + 1, KEY_B.public), id="later than the known ones"),
        pytest.param(initiation_of(c.PROTOCOL_VERSION, KEY_B.public), id="this version"),
        pytest.param(b"\1\7" + initiation_of(1, KEY_B.public)[2:], id="altered"),
        pytest.param(initiation_of(1, KEY_B.public, wire.MACS_BYTES), id="macs alone"),
        pytest.param(initiation_of(1, KEY_B.public, c.VERSION_CHECK_BYTES + 1), id="takes long to hash"),
        *(pytest.param(bytes((kind,)) + initiation_of(1, KEY_B.public)[1:]) for kind in (2, 3, 0x40, 0xFD)),
    ],
)
def test_other_messages_are_of_no_version(message: bytes) -> None:
    """A drop names a version only of an initiation whose mac1 fits. No daemon answers another version."""
    assert reasons(Pair().b.receive(message, 1.0)) != [DropReason.OTHER_VERSION]
    assert message[0] != 1 or version_of(message, KEY_B.public) is None


def test_flood_leaves_known_addresses_their_comparisons() -> None:
    """Above the limit the reason is as if no version were known. A peer's tries stay within its share."""
    pair = Pair().establish()
    initiation = initiation_of(1, KEY_B.public)

    def named(source: Path, now: float, count: int) -> int:
        fates = [reasons(pair.b.receive(initiation, now, source)) for _ in range(count)]
        other = [fate for fate in fates if fate not in ([DropReason.MALFORMED], [DropReason.BAD_MAC1])]
        assert other == [[DropReason.OTHER_VERSION]] * len(other)
        return len(other)

    assert named(ELSEWHERE, 1.0, 3 * c.VERSION_CHECKS.burst) == c.VERSION_CHECKS.burst
    assert named(AT_A, 1.0, 2 * c.VERSION_CHECKS_PER_KNOWN.burst) == c.VERSION_CHECKS_PER_KNOWN.burst
    assert named(ELSEWHERE, 2.0, c.VERSION_CHECKS.burst) == c.VERSION_CHECKS.per_s
    for number in range(100):
        now = 10.0 + number * c.RETRY_MIN_S
        named(ELSEWHERE, now, c.VERSION_CHECKS.burst)
        assert named(AT_A, now, 1) == 1
    assert pair.carries(50.0)
