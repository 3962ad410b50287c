"""Nodes in the states in which datagrams find them, set up once and copied cheaply."""

from __future__ import annotations

import copy
import gc
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, Final, TypeVar

from tests.core.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    KEY_B,
    KEY_C,
    PLAIN,
    PRIVATE_B,
    UNUSED_INDEX,
    Pair,
    Side,
    datagrams,
    only,
    quiet,
)
from uavlinkd.core import wire
from uavlinkd.core.cookie import MacKeys, mac1_of
from uavlinkd.core.crypto import AeadKey, KeyPair, MacKey, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.noise import HandshakeState
from uavlinkd.core.outputs import Path
from uavlinkd.core.session import Authenticated, Confidential
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES_BY_NAME, Suite

T = TypeVar("T")

NOW: Final = 100.0
"""When the scripts begin."""
PSK: Final = Secret(bytes(range(32)))
GROUPS: Final = tuple(SUITES_BY_NAME[name] for name in ("x25519", "mlkem768", "ffdhe2048"))


class Chance:
    """Entropy that is the same each time, and small enough to be copied."""

    __slots__ = ("_drawn", "_seed")

    def __init__(self, seed: int) -> None:
        self._seed = seed.to_bytes(4, "big")
        self._drawn = 0

    def __call__(self, size: int, /) -> bytes:
        """As many bytes."""
        self._drawn += 1
        return hashlib.shake_128(self._seed + self._drawn.to_bytes(8, "big")).digest(size)


_IMMUTABLE = (
    *(KeyPair, MacKey, AeadKey, Secret, MacKeys, HandshakeState, Authenticated, Confidential),
    *(PeerSettings, Link, Suite),
)
"""What a copy may share with the original. Most of these hold keys of OpenSSL's, which cannot be copied."""
_NO_DATA = (type, ModuleType, FunctionType, BuiltinFunctionType, str, bytes, int, float)


def copier(thing: T) -> Callable[[], T]:
    """A function that gives deep copies of this, as it is now."""
    shared: dict[int, Any] = {}
    seen: set[int] = set()
    todo: list[Any] = [thing]
    while todo:
        each = todo.pop()
        if id(each) in seen or isinstance(each, _NO_DATA):
            continue
        seen.add(id(each))
        if isinstance(each, _IMMUTABLE):
            shared[id(each)] = each
        else:
            todo += gc.get_referents(each)
    original = copy.deepcopy(thing, dict(shared))
    return lambda: copy.deepcopy(original, dict(shared))


@dataclass
class Stage:
    """A node that waits for what comes, and what an attacker has recorded of what went by."""

    pair: Pair
    is_alpha: bool
    """Whether alpha is the victim; else bravo."""
    genuine: bytes
    """What the victim waits for: the one datagram that may change anything."""
    templates: tuple[bytes, ...]
    others: tuple[bytes, ...] = ()
    """More that is genuine: as it is, it is no forgery."""
    now: float = NOW
    sources: tuple[Path, ...] = (ELSEWHERE, AT_A, AT_B, (1, "2001:db8::7", 9))
    cookies: tuple[bytes, ...] = ()
    """Cookie replies that fit: whoever sees the datagrams of two whose public keys it knows can make them."""
    public_keys: tuple[bytes, ...] = ()
    """The victim's: by these ``mac1`` is made right."""

    def __post_init__(self) -> None:
        """An envelope of no session comes from the peer's address: the victim calls, and not again for a second."""
        self.public_keys = self.public_keys or (self.victim.node.public_key,)
        self.victim.receive(wire.envelope_header(UNUSED_INDEX, 0) + bytes(36), self.now)

    @property
    def victim(self) -> Side:
        """The side that is fuzzed."""
        return self.pair.a if self.is_alpha else self.pair.b

    @property
    def other(self) -> Side:
        """The side that it is linked with, or will be."""
        return self.pair.b if self.is_alpha else self.pair.a


def pair_of(link_a: Link = PLAIN, link_b: Link | None = None, seed: int = 1, psk: Secret | None = None) -> Pair:
    """Alpha and bravo, who calls alpha too; bravo also knows charlie, who has no address."""
    pair = Pair(link_a=link_a, link_b=link_b or link_a, psk_a=psk, psk_b=psk, seed=seed, now=NOW)
    _make_small(pair, seed)
    pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public, None, link_a), NOW)
    return pair


def _make_small(pair: Pair, seed: int) -> None:
    for number, side in enumerate((pair.a, pair.b)):
        chance = Chance(seed + number)
        node = side.node
        # The generator of the harness is a large thing to copy.
        node._entropy = node._cookies._entropy = node._indices._entropy = chance
        for peer in node.peers.values():
            peer._entropy = peer.caller._entropy = peer._challenger._entropy = chance


def _cookie_for(message: bytes, receiver: bytes, index: int) -> bytes:
    nonce = bytes(range(16))
    return wire.encode_cookie_reply(index, nonce, MacKeys(receiver).seal_cookie(b"c" * 16, nonce, mac1_of(message)))


def idle(link: Link, psk: Secret | None = None) -> Stage:
    """Bravo has heard nothing from anybody."""
    pair = pair_of(link, psk=psk)
    initiation = pair.initiation(NOW)
    return Stage(pair, False, initiation, (initiation,))


def idle_in_key_change(link: Link) -> Stage:
    """Bravo has a new key, and takes its former one as well; alpha, who calls, knows the former."""
    pair = pair_of(link)
    alpha = pair.b.peer.settings
    node = pair.b.node = Node(Secret(bytes([7]) * 32), Chance(2), NOW, Secret(PRIVATE_B))
    node.add_peer(alpha, NOW, by_previous_key=True)
    node.add_peer(replace(alpha, name="alpha by the new key"), NOW)
    _make_small(pair, 1)
    initiation = pair.initiation(NOW)
    keys = node.public_key, KEY_B.public
    return Stage(pair, False, initiation, (initiation,), public_keys=keys)


def initiator(link: Link, psk: Secret | None = None) -> Stage:
    """Alpha has sent an initiation and waits for the response; bravo, who calls too, has sent one as well."""
    pair = pair_of(link, psk=psk)
    initiation = pair.initiation(NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    pair.b.knows_the_way(NOW)
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
    """Alpha and bravo are linked, frames have crossed; more of alpha's are on their way."""
    pair = pair_of(link)
    initiation = pair.initiation(NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    confirmation = only(datagrams(pair.a.receive(response, NOW)))
    pair.b.receive(confirmation, NOW)
    for side in (pair.a, pair.b):
        side.timeout(NOW)
    pair.a.session.send_counter = max(counter, pair.a.session.send_counter)
    past = [pair.a.envelope(NOW) for _ in range(3)]
    for each in past:
        pair.b.receive(each, NOW)
    coming = [pair.a.envelope(NOW), pair.a.envelope(NOW, b""), pair.a.envelope(NOW, wire.Close().encode())]
    pair.a.session.send_counter -= 2  # the last two are never sent, so the next one is not beyond them
    answer = pair.b.envelope(NOW)
    templates = (*coming, past[0], confirmation, initiation, response, answer)
    return Stage(pair, False, coming[0], templates, tuple(coming[1:]))


LINKS: Final = (
    quiet(),
    quiet(tag_bytes=8),
    quiet(tag_bytes=32, mac_key_bits=1024),
    quiet(confidential=True),
)
"""Kinds of sessions."""


def with_suite(link: Link, suite: Suite) -> Link:
    """The same link, with an extra exchange."""
    return replace(link, suites=(suite,))
