"""mac1, mac2 and cookies: who may cost us a key exchange."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_A, ELSEWHERE, KEY_A, KEY_B, flipped, seeded
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.cookie import CookieJar, MacKeys, mac1_of
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.path import Path

KEYS = MacKeys(KEY_B.public)
MESSAGE = b"\1\0\0\7" + bytes(range(100))
LIFETIME = c.COOKIE_SECRET_LIFETIME_S


def cookie_from(jar: CookieJar, datagram: bytes, now: float) -> bytes:
    """The cookie that the jar gives to alpha, opened as alpha opens it."""
    reply = wire.parse_cookie_reply(jar.reply(datagram, 7, AT_A, now))
    assert reply.receiver_index == 7
    return KEYS.open_cookie(reply, mac1_of(datagram))


@pytest.fixture
def jar() -> CookieJar:
    """The responder's jar, opened at 1000 s."""
    return CookieJar(KEYS, seeded(1), 1000.0)


def test_mac1_shows_knowledge_of_the_public_key() -> None:
    """A message with macs passes; one made for another key does not."""
    KEYS.check_mac1(KEYS.add_macs(MESSAGE, None))

    with pytest.raises(Drop) as caught:
        KEYS.check_mac1(MacKeys(KEY_A.public).add_macs(MESSAGE, None))
    assert caught.value.reason is DropReason.BAD_MAC1


def test_mac1_covers_every_byte_before_it() -> None:
    """A bit turned over in any byte of message or mac1 is noticed; mac2 is outside of it."""
    datagram = KEYS.add_macs(MESSAGE, None)

    for position in range(len(datagram) - c.MAC_BYTES):
        with pytest.raises(Drop) as caught:
            KEYS.check_mac1(flipped(datagram, position, position % 8))
        assert caught.value.reason is DropReason.BAD_MAC1
    KEYS.check_mac1(flipped(datagram, len(datagram) - 1))


def test_without_a_cookie_mac2_is_zero() -> None:
    """Sixteen zero bytes say: no cookie."""
    assert KEYS.add_macs(MESSAGE, None)[-16:] == bytes(16)
    assert KEYS.add_macs(MESSAGE, b"c" * 16)[-16:] != bytes(16)


def test_cookie_admits_its_source(jar: CookieJar) -> None:
    """The holder of a cookie can make a valid mac2 with it, over any message."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), 1000.0)

    assert jar.has_valid_mac2(KEYS.add_macs(MESSAGE, cookie), AT_A, 1000.0)
    assert jar.has_valid_mac2(KEYS.add_macs(b"other" + MESSAGE, cookie), AT_A, 1001.0)


def test_mac2_covers_everything_before_it(jar: CookieJar) -> None:
    """A bit turned over in any byte, mac2's own included, and the cookie does not count."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), 1000.0)
    datagram = KEYS.add_macs(MESSAGE, cookie)

    for position in range(len(datagram)):
        assert not jar.has_valid_mac2(flipped(datagram, position, position % 8), AT_A, 1000.0)
    assert not jar.has_valid_mac2(KEYS.add_macs(MESSAGE, None), AT_A, 1000.0)


@pytest.mark.parametrize(
    "path", [ELSEWHERE, Path(0, (AT_A.host, AT_A.address[1] + 1)), Path(0, ("192.0.2.11", 4600))]
)
def test_cookie_is_bound_to_its_source(jar: CookieJar, path: Path) -> None:
    """From another host or port the same cookie is worth nothing."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), 1000.0)

    assert not jar.has_valid_mac2(KEYS.add_macs(MESSAGE, cookie), path, 1000.0)


@pytest.mark.parametrize("given", [1000.0, 1000.0 + LIFETIME / 2, 1000.0 + LIFETIME - 0.001])
@pytest.mark.parametrize("asked_between", [False, True])
def test_cookie_lives_between_one_and_two_lifetimes(jar: CookieJar, given: float, asked_between: bool) -> None:
    """A cookie is honoured until the secret after its own ends, whether or not anyone asked in between."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), given)
    datagram = KEYS.add_macs(MESSAGE, cookie)
    end = 1000.0 + 2 * LIFETIME
    if asked_between:
        assert jar.has_valid_mac2(datagram, AT_A, given + LIFETIME)

    assert jar.has_valid_mac2(datagram, AT_A, end - 0.001)
    assert not jar.has_valid_mac2(datagram, AT_A, end)


def test_late_check_does_not_extend_a_cookies_life(jar: CookieJar) -> None:
    """A secret changes when it is due, not when the next message happens to come."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), 1000.0)
    datagram = KEYS.add_macs(MESSAGE, cookie)

    assert jar.has_valid_mac2(datagram, AT_A, 1000.0 + 2 * LIFETIME - 1)
    assert not jar.has_valid_mac2(datagram, AT_A, 1000.0 + 2 * LIFETIME + 1)


def test_after_a_long_silence_no_old_cookie_is_honoured(jar: CookieJar) -> None:
    """Two lifetimes without a message end both secrets at once."""
    cookie = cookie_from(jar, KEYS.add_macs(MESSAGE, None), 1000.0)

    assert not jar.has_valid_mac2(KEYS.add_macs(MESSAGE, cookie), AT_A, 1000.0 + 10 * LIFETIME)


def test_sealed_cookie_opens_for_the_asker_alone(jar: CookieJar) -> None:
    """A cookie is bound to the message that asked for it and to the responder's key, and no byte may be altered."""
    datagram = KEYS.add_macs(MESSAGE, None)
    raw = jar.reply(datagram, 7, AT_A, 1000.0)
    other_mac1 = mac1_of(KEYS.add_macs(b"other" + MESSAGE, None))
    reply = wire.parse_cookie_reply(raw)

    attempts = [(KEYS, reply, other_mac1), (MacKeys(KEY_A.public), reply, mac1_of(datagram))]
    attempts += [
        (KEYS, wire.parse_cookie_reply(flipped(raw, position)), mac1_of(datagram)) for position in range(4, len(raw))
    ]
    for keys, altered, mac1 in attempts:
        with pytest.raises(Drop) as caught:
            keys.open_cookie(altered, mac1)
        assert caught.value.reason is DropReason.BAD_COOKIE
    assert len(KEYS.open_cookie(reply, mac1_of(datagram))) == c.MAC_BYTES


def test_every_reply_has_a_fresh_nonce(jar: CookieJar) -> None:
    """The same cookie is never sealed twice under one key."""
    datagram = KEYS.add_macs(MESSAGE, None)
    nonces = {wire.parse_cookie_reply(jar.reply(datagram, 7, AT_A, 1000.0)).nonce for _ in range(50)}

    assert len(nonces) == 50
