"""No object of the core tells a secret when it is printed."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import Any

import pytest

from tests.protocol.harness import FRAME, Pair, datagrams, exhaust, only, quiet, seeded
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Entropy, Secret
from uavlinkd.protocol.noise import SymmetricState
from uavlinkd.protocol.suites import SUITES_BY_NAME, Suite

KINDS = [pytest.param(SUITES_BY_NAME[name], id=name) for name in ("x25519", "ffdhe2048", "mlkem768")]
PSK = bytes(range(100, 132))
PRIVATE_KEYS = [bytes([1]) * 32, bytes([2]) * 32]


def recording(seed: int, drawn: list[bytes]) -> Entropy:
    """Entropy that keeps what it gave."""
    draw = seeded(seed)

    def recorded(size: int, /) -> bytes:
        drawn.append(draw(size))
        return drawn[-1]

    return recorded


def reachable(thing: Any, seen: dict[int, Any]) -> Iterator[Any]:
    """Every object of the core that can be reached from this one."""
    if id(thing) in seen or thing is None or isinstance(thing, bool | int | float | str | bytes | type | array):
        return
    seen[id(thing)] = thing
    if type(thing).__module__.startswith("uavlinkd."):
        yield thing
    inside: list[Any] = []
    if isinstance(thing, dict):
        inside = [*thing.keys(), *thing.values()]
    elif isinstance(thing, list | tuple | set | frozenset):
        inside = list(thing)
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    inside += [getattr(thing, name) for name in [*slots, *getattr(thing, "__dict__", {})] if hasattr(thing, name)]
    for item in inside:
        yield from reachable(item, seen)


def shows(text: str, secret: bytes) -> bool:
    """Whether a text has a telling part of a secret, as hexadecimal, as Python writes bytes, or as a number."""
    part = secret[:12]
    return part.hex() in text or repr(part)[2:-1] in text or str(int.from_bytes(secret, "big")) in text


def test_detector_sees_what_is_shown() -> None:
    """What this file looks for would be found."""
    assert shows(f"Key({PSK!r})", PSK)
    assert shows(f"key={PSK.hex()}", PSK)
    assert shows(f"exponent={int.from_bytes(PSK, 'big')}", PSK)
    assert not shows(repr(Secret(PSK)), PSK)


@pytest.mark.parametrize("suite", KINDS)
def test_no_object_shows_a_secret(suite: Suite) -> None:
    """At each stage of a link, under load too, no object prints keys, PSKs, ephemerals, cookies or chaining keys."""
    link = quiet(suites=(suite,))
    pair = Pair(link_a=link, link_b=link, psk_a=Secret(PSK), psk_b=Secret(PSK))
    drawn: list[bytes] = []
    for number, side in enumerate((pair.a, pair.b)):
        entropy = recording(50 + number, drawn)
        side.node._entropy = side.peer.entropy = side.peer.initiator._entropy = entropy
        side.node._indices._entropy = side.node._handshakes.cookies._entropy = entropy
    printed, kinds, chaining_keys = list[str](), set[str](), list[bytes]()

    def look(*more: object) -> None:
        for thing in reachable([pair.a.node, pair.b.node, *more], {}):
            printed.append(f"{thing!r} {thing}")
            kinds.add(type(thing).__name__)
            if isinstance(thing, SymmetricState):
                chaining_keys.append(thing.ck)

    initiation = pair.initiation(0.0)
    look()
    response = only(datagrams(pair.b.receive(initiation, 0.0)))
    look()
    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    look()
    outputs = pair.b.receive(confirmation, 0.0)
    look(outputs)
    now = c.REKEY_AFTER_S
    again = pair.initiation(now)
    exhaust(pair.b, now)
    pair.a.receive(only(datagrams(pair.b.receive(again, now))), now)
    look(pair.a.send(now, FRAME))

    assert {"Session", "Pending", "Unconfirmed", "HandshakeState", "Secret", "MacKey", "CookieJar"} <= kinds
    secrets = [*PRIVATE_KEYS, PSK, *chaining_keys, *(value for value in drawn if len(value) >= 32)]
    assert len(secrets) > 6
    text = "\n".join(printed)
    assert not any(shows(text, secret) for secret in secrets)
