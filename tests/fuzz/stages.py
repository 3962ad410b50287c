"""Nodes in the states in which they receive datagrams, created once and copied cheaply."""

from __future__ import annotations

import copy
import gc
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, Final, TypeVar

from tests.protocol import inside
from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    KEY_C,
    PLAIN,
    UNUSED_INDEX,
    Pair,
    Side,
    datagrams,
    only,
    quiet,
)
from uavlinkd.protocol import wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.crypto import AeadKey, KeyPair, MacKey, Secret
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME, Suite

T = TypeVar("T")

NOW: Final = 100.0
"""The time when the scripts start."""
PSK: Final = Secret(bytes(range(32)))
GROUPS: Final = tuple(SUITES_BY_NAME[name] for name in ("x25519", "mlkem768", "ffdhe2048"))


class SeededEntropy:
    """Reproducible entropy, small enough to be copied."""

    __slots__ = ("_drawn", "_seed")

    def __init__(self, seed: int) -> None:
        self._seed = seed.to_bytes(4, "big")
        self._drawn = 0

    def __call__(self, size: int, /) -> bytes:
        """The next ``size`` bytes."""
        self._drawn += 1
        return hashlib.shake_128(self._seed + self._drawn.to_bytes(8, "big")).digest(size)


_IMMUTABLE = (*(KeyPair, MacKey, AeadKey, Secret, MacKeys), *(PeerSettings, Link, Suite))
"""Types that a copy shares with the original. Most contain keys of OpenSSL, which cannot be copied."""
_NO_DATA = (type, ModuleType, FunctionType, BuiltinFunctionType, str, bytes, int, float)


def copier(thing: T) -> Callable[[], T]:
    """A function that returns deep copies of an object in its present state."""
    shared: dict[int, Any] = {}
    seen: set[int] = set()
    todo: list[Any] = [thing]
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, _NO_DATA):
            continue
        seen.add(id(item))
        if isinstance(item, _IMMUTABLE):
            shared[id(item)] = item
        else:
            todo += gc.get_referents(item)
    original = copy.deepcopy(thing, dict(shared))
    return lambda: copy.deepcopy(original, dict(shared))


@dataclass
class Stage:
    """A node that waits for datagrams, and the traffic that an attacker has recorded."""

    pair: Pair
    is_alpha: bool
    """Whether alpha is the victim; otherwise bravo is."""
    genuine: bytes
    """The one datagram that the victim waits for, and that may change its state."""
    templates: tuple[bytes, ...]
    others: tuple[bytes, ...] = ()
    """Other genuine datagrams: unaltered, they are not forgeries."""
    now: float = NOW
    sources: tuple[Path, ...] = (ELSEWHERE, AT_A, AT_B, Path(1, ("2001:db8::7", 9, 0, 0)))
    cookies: tuple[bytes, ...] = ()
    """Matching cookie replies: an attacker that sees the datagrams and knows both public keys can make them."""

    def __post_init__(self) -> None:
        """An envelope of no session arrives from the peer's address: the victim initiates, then waits a second."""
        self.victim.receive(wire.envelope_header(UNUSED_INDEX, 0) + bytes(36), self.now)

    @property
    def victim(self) -> Side:
        """The side under test."""
        return self.pair.a if self.is_alpha else self.pair.b

    @property
    def other(self) -> Side:
        """The side that it is linked with, or will be."""
        return self.pair.b if self.is_alpha else self.pair.a


def pair_of(link_a: Link = PLAIN, link_b: Link | None = None, seed: int = 1, psk: Secret | None = None) -> Pair:
    """Alpha and bravo, which initiates too; bravo also knows charlie, which has no address."""
    pair = Pair(link_a=link_a, link_b=link_b or link_a, psk_a=psk, psk_b=psk, seed=seed, now=NOW)
    _make_small(pair, seed)
    pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public, None, link_a), NOW)
    return pair


def _make_small(pair: Pair, seed: int) -> None:
    for number, side in enumerate((pair.a, pair.b)):
        # The generator of the harness would make copies slow.
        inside.set_entropy(side.node, SeededEntropy(seed + number))


def _cookie_for(message: bytes, receiver: bytes, index: int) -> bytes:
    nonce = bytes(range(16))
    return wire.encode_cookie_reply(index, nonce, MacKeys(receiver).seal_cookie(b"c" * 16, nonce, mac1_of(message)))


def idle(link: Link, psk: Secret | None = None) -> Stage:
    """Bravo has received nothing."""
    pair = pair_of(link, psk=psk)
    initiation = pair.initiation(NOW)
    return Stage(pair, False, initiation, (initiation,))


def initiator(link: Link, psk: Secret | None = None) -> Stage:
    """Alpha has sent an initiation and waits for the response; bravo, which initiates too, has sent one as well."""
    pair = pair_of(link, psk=psk)
    initiation = pair.initiation(NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    pair.b.configure_path(NOW)
    crossing = only(datagrams(pair.b.timeout(NOW), wire.INITIATION))
    index = int.from_bytes(initiation[2:4], "big")
    cookie = _cookie_for(initiation, pair.b.node.public_key, index)
    return Stage(pair, True, response, (response, crossing, initiation, cookie), (crossing,), cookies=(cookie,))


def responder(link: Link, psk: Secret | None = None) -> Stage:
    """Bravo has answered and waits for the envelope that confirms the session."""
    pair = pair_of(link, psk=psk)
    initiation = pair.initiation(NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    confirmation = only(datagrams(pair.a.receive(response, NOW)))
    index = int.from_bytes(response[2:4], "big")
    cookie = _cookie_for(response, pair.a.node.public_key, index)
    more = tuple(pair.a.envelope(NOW) for _ in range(2))
    templates = (confirmation, *more, initiation, response, cookie)
    return Stage(pair, False, confirmation, templates, more, cookies=(cookie,))


def session(link: Link, counter: int = 0) -> Stage:
    """Alpha and bravo are linked, frames have crossed, and more of alpha's are in flight."""
    pair = pair_of(link)
    initiation = pair.initiation(NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    confirmation = only(datagrams(pair.a.receive(response, NOW)))
    pair.b.receive(confirmation, NOW)
    for side in (pair.a, pair.b):
        side.timeout(NOW)
    pair.a.session.send_counter = max(counter, pair.a.session.send_counter)
    past = [pair.a.envelope(NOW) for _ in range(3)]
    for envelope in past:
        pair.b.receive(envelope, NOW)
    coming = [pair.a.envelope(NOW), pair.a.envelope(NOW, b""), pair.a.envelope(NOW, wire.Close().encode())]
    pair.a.session.send_counter -= 2  # the last two are never sent, so the next one is not beyond them
    answer = pair.b.envelope(NOW)
    templates = (*coming, past[0], confirmation, initiation, response, answer)
    return Stage(pair, False, coming[0], templates, tuple(coming[1:]))


LINKS: Final = (quiet(), quiet(tag_bytes=8), quiet(tag_bytes=12), quiet(confidential=True))
"""Kinds of sessions."""


def with_suite(link: Link, suite: Suite) -> Link:
    """The same link, with an additional exchange."""
    return replace(link, suites=(suite,))
