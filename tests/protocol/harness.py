"""Two nodes on a table: every datagram is handed over by the test, and ``now`` is a literal."""

from __future__ import annotations

import hashlib
import hmac
import random
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, handshake, wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.crypto import AeadKey, KeyPair, MacKey, Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Dropped, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.session import EnvelopeKey, Session
from uavlinkd.protocol.settings import Link, PeerSettings, Timers
from uavlinkd.protocol.suites import SUITES_BY_NAME
from uavlinkd.protocol.wire import Probe

T = TypeVar("T")

_KEYS = sorted((bytes([number]) * 32 for number in (1, 2)), key=lambda private: KeyPair(private).public)
_, PRIVATE_B = _KEYS
KEY_A, KEY_B = (KeyPair(private) for private in _KEYS)
"""Alpha's public key is the smaller one."""
KEY_C = KeyPair(bytes([3]) * 32)

AT_A = Path(0, ("192.0.2.1", 14600))
AT_B = Path(0, ("192.0.2.2", 14600))
ELSEWHERE = Path(0, ("198.51.100.9", 4000))
UNUSED_INDEX = 0xFFFF
"""An index that no session of these tests draws."""

FRAME = bytes((0xFD, 9, 0, 0, 1, 1, 1, 0, 0, 0)) + bytes(9) + b"\x12\x34"
QUIET = Timers(keepalive_s=1e6, echo_after_s=1e6, handshake_after_s=1e6, lost_after_s=1e6, probe_interval_s=0.0)
"""No timer but those of handshakes and keys."""

PLAIN = Link(suites=(SUITES_BY_NAME["x25519"],), verify_interval_s=1e6)
"""Freshness stays verified."""


def seeded(seed: int) -> Callable[[int], bytes]:
    """Entropy that is the same each time."""
    return random.Random(seed).randbytes


class Named(NamedTuple):
    """A peer of which only the name counts."""

    name: str


@dataclass
class Side:
    """One node, where others see it, and its only peer."""

    node: Node
    at: Path
    peer_name: str
    peer_at: Path

    @property
    def peer(self) -> Peer:
        """The state kept for the other side."""
        return self.node.peers[self.peer_name]

    @property
    def session(self) -> Session:
        """The session that sends."""
        session = self.peer.sessions.current
        assert session is not None
        return session

    def receive(self, datagram: bytes, now: float, source: Path | None = None) -> list[Output]:
        """Hand a datagram over; it comes from the other side's address by default."""
        return self.node.receive(datagram, source or self.peer_at, now)

    def send(self, now: float, *frames: bytes) -> list[Output]:
        """Send frames (one by default) to the other side."""
        return self.node.send(self.peer, frames or (FRAME,), now)

    def timeout(self, now: float) -> list[Output]:
        """Let the timers run."""
        return self.node.handle_timeout(now)

    def configure_path(self, now: float) -> None:
        """Configure the other side's address, so that this side initiates."""
        self.node.set_paths(self.peer, [self.peer_at], now)

    def envelope(self, now: float, payload: bytes = FRAME) -> bytes:
        """Any payload sealed on the current session: what only the holder of the keys can make."""
        return self.session.seal(payload, now)


@dataclass
class Pair:
    """Alpha and bravo. Alpha initiates; bravo only knows alpha's key, until :meth:`Side.configure_path`."""

    link_a: Link = PLAIN
    link_b: Link = PLAIN
    psk_a: Secret | None = None
    psk_b: Secret | None = None
    seed: int = 1
    now: float = 0.0
    swapped: bool = False
    """Alpha has the greater public key instead."""
    a: Side = field(init=False)
    b: Side = field(init=False)

    def __post_init__(self) -> None:
        private_a, private_b = _KEYS[::-1] if self.swapped else _KEYS
        public_a, public_b = (KeyPair(private).public for private in (private_a, private_b))
        node_a = Node(Secret(private_a), seeded(self.seed), self.now)
        node_b = Node(Secret(private_b), seeded(self.seed + 1), self.now)
        node_a.add_peer(PeerSettings("bravo", public_b, self.psk_a, self.link_a), self.now)
        node_b.add_peer(PeerSettings("alpha", public_a, self.psk_b, self.link_b), self.now)
        self.a = Side(node_a, AT_A, "bravo", AT_B)
        self.b = Side(node_b, AT_B, "alpha", AT_A)
        self.a.configure_path(self.now)

    def initiation(self, now: float) -> bytes:
        """Alpha's next initiation."""
        return only(datagrams(self.a.timeout(now), wire.INITIATION))

    def establish(self, now: float = 0.0) -> Pair:
        """Initiation, response, confirmation and what follows: afterwards both sides send on the session."""
        self.complete(self.initiation(now), now)
        self.a.timeout(now)
        self.b.timeout(now)
        return self

    def complete(self, initiation: bytes, now: float) -> list[Output]:
        """Let bravo answer this initiation of alpha, and either side what follows. Bravo's outputs after that."""
        response = only(datagrams(self.b.receive(initiation, now), wire.RESPONSE))
        return exchange(self.b, self.a, self.a.receive(response, now), now)

    def rekey(self, now: float) -> list[Output]:
        """Alpha makes new keys. Bravo receives the confirmation, and nothing after that arrives. Bravo's outputs."""
        response = only(datagrams(self.b.receive(only(datagrams(establish.initiate(self.a.peer, now))), now)))
        return self.b.receive(only(datagrams(self.a.receive(response, now))), now)

    def carries(self, now: float) -> bool:
        """Whether a frame gets through in both directions."""
        return self.crosses(self.a, self.b, now) and self.crosses(self.b, self.a, now)

    @staticmethod
    def crosses(source: Side, target: Side, now: float) -> bool:
        """Whether a frame gets from one side to the other, after a question about its age if need be."""
        arrived = exchange(target, source, source.send(now), now)
        return payloads(arrived) == [FRAME]


def run(pair: Pair, start: float, until: float, passes: Callable[[Side, bytes, float], bool]) -> Iterator[float]:
    """Let both sides' timers run; ``passes(sender, datagram, now)`` says what arrives. Yields each moment."""
    queue: list[tuple[Side, list[Output]]] = []
    now = start
    for _ in range(20000):
        for side in (pair.a, pair.b):
            if side.node.next_deadline() <= now:
                queue.append((side, side.timeout(now)))
        while queue:
            side, outputs = queue.pop(0)
            other = pair.b if side is pair.a else pair.a
            for out in outputs:
                if isinstance(out, Transmit) and out.path == other.at and passes(side, out.datagram, now):
                    queue.append((other, other.receive(out.datagram, now)))
        yield now
        now = max(now, min(pair.a.node.next_deadline(), pair.b.node.next_deadline()))
        if now > until:
            return
    raise AssertionError("the timers run in a circle")


def exchange(one: Side, other: Side, outputs: list[Output], now: float) -> list[Output]:
    """Hand over what ``other`` sends, and what either answers, until both are quiet. All outputs of ``one``."""
    seen: list[Output] = []
    while sent := datagrams(outputs):
        answers = [out for datagram in sent for out in one.receive(datagram, now)]
        seen += answers
        outputs = [out for datagram in datagrams(answers) for out in other.receive(datagram, now)]
    return seen


def of(outputs: Iterable[Output], kind: type[T]) -> list[T]:
    """The outputs of one kind."""
    return [out for out in outputs if isinstance(out, kind)]


def datagrams(outputs: Iterable[Output], *kinds: int) -> list[bytes]:
    """What is to be transmitted, of these message types if any are given."""
    return [out.datagram for out in of(outputs, Transmit) if not kinds or out.datagram[0] in kinds]


def payloads(outputs: Iterable[Output]) -> list[bytes]:
    """What was delivered."""
    return [out.payload for out in of(outputs, Deliver)]


def reasons(outputs: Iterable[Output]) -> list[DropReason]:
    """Why something was dropped."""
    return [out.reason for out in of(outputs, Dropped)]


def only(values: list[T]) -> T:
    """The one element."""
    assert len(values) == 1, values
    return values[0]


def flipped(datagram: bytes, position: int, bit: int = 0) -> bytes:
    """The datagram with one bit turned over."""
    changed = bytearray(datagram)
    changed[position] ^= 1 << bit
    return bytes(changed)


def with_macs(message: bytes, receiver_public_key: bytes, cookie: bytes | None = None) -> bytes:
    """A handshake message with the macs that anyone can make who knows the receiver's public key."""
    return MacKeys(receiver_public_key).add_macs(message, cookie)


def repaired(datagram: bytes, receiver_public_key: bytes) -> bytes:
    """An altered handshake message with its mac1 made right again."""
    return with_macs(datagram[: -wire.MACS_BYTES], receiver_public_key)


def unsealed(session: Session, datagram: bytes) -> bytes | None:
    """The payload of an envelope by a session's key alone: nothing else is checked, and nothing changes."""
    _, counter, size = wire.parse_envelope_header(datagram)
    return unprotected(session._receive, session.tag_bytes, datagram, size, counter)


def probe_in(side: Side, datagram: bytes) -> Probe:
    """The probe in an envelope to a side, read with its keys and past its session."""
    session = next(one for one in side.peer.sessions.confirmed if datagram[1:3] == one.local_index.to_bytes(2))
    payload = unsealed(session, datagram)
    assert payload is not None
    record = wire.parse_control(payload)
    assert isinstance(record, wire.ProbeAndFrames)
    return record.probe


def unprotected(key: EnvelopeKey, tag_bytes: int, datagram: bytes, header_bytes: int, counter: int) -> bytes | None:
    """The payload of an envelope; None if the tag does not verify."""
    if isinstance(key, AeadKey):
        return key.open(counter, datagram[header_bytes:], datagram[:header_bytes])
    covered = datagram[:-tag_bytes]
    return covered[header_bytes:] if key.tag(covered)[:tag_bytes] == datagram[-tag_bytes:] else None


def stray() -> bytes:
    """An envelope for an unknown session."""
    return wire.envelope_header(UNUSED_INDEX, 5) + bytes(24)


def initiation_of(version: int, receiver_public_key: bytes, length: int = 147) -> bytes:
    """An initiation as another version of the protocol makes it: only its first byte and its macs are known here."""
    covered = (b"\1" + bytes(range(256)) * (length // 256 + 1))[: length - 2 * c.MAC_BYTES]
    key = hashlib.sha256(b"uavlink/%d mac1" % version + receiver_public_key).digest()
    return covered + hmac.digest(key, covered, "sha256")[: c.MAC_BYTES] + bytes(c.MAC_BYTES)


_ENTROPY = seeded(77)


def made_initiation(
    identity: KeyPair = KEY_A, to: KeyPair = KEY_B, link: Link = PLAIN, index: int = 77, psk: Secret | None = None
) -> bytes:
    """An initiation by the holder of this identity, made by hand."""
    initiated = handshake.initiate(identity, PeerSettings("peer", to.public, psk, link), index, 0, _ENTROPY)
    return with_macs(initiated.message, to.public)


def with_cookie(side: Side, initiation: bytes, place: Path, now: float) -> bytes:
    """An initiation to a side, with the cookie that it gives to its sender at a place."""
    cookies, sender_index = side.node._handshakes.cookies, wire.parse_initiation(initiation).sender_index
    reply = wire.parse_cookie_reply(cookies.reply(initiation, sender_index, place, now))
    cookie = cookies.keys.open_cookie(reply, mac1_of(initiation))
    return with_macs(initiation[: -wire.MACS_BYTES], side.node.public_key, cookie)


def exhaust(side: Side, now: float) -> None:
    """Bring a node under load: its budget of initiations and of responses is spent."""
    for bucket in (side.node._handshakes.admission._initiations, side.node._handshakes.admission._responses):
        while bucket.take(now):
            pass


def lively(**changes: float) -> Link:
    """A link whose timers are the ordinary ones but for these."""
    return replace(PLAIN, timers=replace(Timers(), **changes))


def quiet(**changes: Any) -> Link:
    """A link on which only keys and handshakes have timers."""
    return replace(PLAIN, timers=QUIET, **changes)


ONLY_COUNTED = frozenset(
    ("drops", "_initiations", "_responses", "_read", "_known_read", "_cookie_replies", "_prefixes", "_known")
) | {"_versions", "_known_versions", "_computed", "_entropy"}
"""What a forgery may change."""
_OPAQUE = (KeyPair, AeadKey, MacKey)


def state_of(thing: Any, *, ignoring: frozenset[str] = ONLY_COUNTED) -> Any:
    """All that an object remembers, comparable: what a forgery must leave as it was.

    Left out are the counters of drops, the budgets that forgeries may spend, the generator, and the secret of a
    genuine ciphertext, which an altered copy of its response has computed early.
    """
    return _picture(thing, ignoring, {})


def _picture(thing: Any, ignoring: frozenset[str], seen: dict[int, int]) -> Any:
    if thing is None or isinstance(thing, bool | int | float | str | bytes | type):
        return thing
    if isinstance(thing, Secret):
        return thing.reveal()
    if isinstance(thing, array):
        return thing.tobytes()
    if isinstance(thing, _OPAQUE) or callable(thing):
        return id(thing)
    if id(thing) in seen:
        return f"<{seen[id(thing)]}>"
    seen[id(thing)] = len(seen)
    if isinstance(thing, dict):
        return [(_picture(k, ignoring, seen), _picture(v, ignoring, seen)) for k, v in thing.items()]
    if isinstance(thing, list | tuple | set | frozenset):
        return [_picture(item, ignoring, seen) for item in thing]
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    names = [name for name in [*slots, *getattr(thing, "__dict__", {})] if name not in ignoring]
    if not names:
        return id(thing)
    return [type(thing).__name__, [(name, _picture(getattr(thing, name), ignoring, seen)) for name in names]]
