"""Attacks on the paper's key exchange: public keys altered and replaced as in the paper, and the full relay.

The attacks on data are those of :mod:`uavlinkd.lab.mitm.attacks`, the same for both protocols.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation import paper_protocol as paper
from uavlinkd.lab.mitm.anatomy import Kind, kind_of, mavlink_frame
from uavlinkd.lab.mitm.attack import NEVER, Action, Intervention, Send, Way, What

_PRIME = ffdhe_prime(paper.GROUP_BITS)
ELEMENTS = {"zero": 0, "one": 1, "p-1": _PRIME - 1, "p": _PRIME, "p+1": _PRIME + 1}
_CRC_EXTRA = {0: 50, 30: 39}
"""Of HEARTBEAT and ATTITUDE, which is all that the local programs send."""

Change = Callable[[bytes, Random], tuple[bytes, str]]


def tamper(public: bytes, chance: Random) -> tuple[bytes, str]:
    """Four bytes of the key altered."""
    at = chance.randrange(len(public) - 4)
    part = bytes(byte ^ chance.randrange(1, 256) for byte in public[at : at + 4])
    return public[:at] + part + public[at + 4 :], f"bytes {at} to {at + 3} of the public key altered"


def replace(public: bytes, chance: Random) -> tuple[bytes, str]:
    """Another key, of the attacker's own."""
    return paper.PaperKey().public, "public key replaced"


def tamper_or_replace(public: bytes, chance: Random) -> tuple[bytes, str]:
    """By chance one of the two."""
    return tamper(public, chance) if chance.random() < 0.5 else replace(public, chance)


def invalid(public: bytes, chance: Random) -> tuple[bytes, str]:
    """A number that is no honest public key."""
    name = chance.choice(sorted(ELEMENTS))
    return ELEMENTS[name].to_bytes(paper.KEY_BYTES, "big"), f"public key is {name}"


CHANGES: dict[str, Change] = {
    "tamper-key": tamper,
    "replace-key": replace,
    "random": tamper_or_replace,
    "invalid-element": invalid,
}


class AlterKeys:
    """Changes the public keys in the paper's exchange. An :class:`~uavlinkd.lab.mitm.attack.AttackObject`."""

    def __init__(self, name: str, chance: Random) -> None:
        self.name = name
        self._change = CHANGES[name]
        self._chance = chance
        self._seen = 0

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Change it, if it is a public key."""
        self._seen += 1
        if not paper.is_key(datagram):
            return [Send(datagram, way)]
        public, detail = self._change(datagram[1:], self._chance)
        note = Intervention(now, self.name, What.ALTERED, way, self._seen, kind_of(datagram), len(datagram), detail)
        return [Send(datagram[:1] + public, way), note]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """It has no addresses of its own."""
        return []

    def due(self, now: float) -> list[Action]:
        """It sends nothing by itself."""
        return []

    def next_deadline(self) -> float:
        """Never."""
        return NEVER


class PaperRelay:
    """The man in the middle in full: an exchange of his own with each side, every HMAC made again, frames altered.

    Every second frame is altered. Nobody notices: each side shares a key, with him.
    """

    name = "two-sided-relay"

    def __init__(self) -> None:
        self._waiting: dict[Way, paper.PaperKey] = {}
        self._keys: dict[str, list[bytes]] = {}
        """By the peer that shares them, the newest first."""
        self.exchanges = 0
        self.read = 0
        self.altered = 0

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Answer for the other side, or open, alter and seal again."""
        if paper.is_key(datagram):
            return self._exchange(datagram[0], datagram[1:], way, now)
        if paper.is_data(datagram):
            return self._pass_on(datagram, way, now)
        return [Send(datagram, way)]

    def _exchange(self, kind: int, public: bytes, way: Way, now: float) -> list[Action]:
        own = paper.PaperKey() if kind == paper.HELLO else self._waiting.pop(way, None)
        if own is None:
            return []
        try:
            key = own.mac_key(public)
        except ValueError:
            return []
        self._keys[way.sender] = [key, *self._keys.get(way.sender, [])[:1]]
        self.exchanges += 1
        if kind == paper.ANSWER:
            return [self._note(way, now, "keys exchanged with the responder", b"\2")]
        other = self._waiting[way.back] = paper.PaperKey()
        return [
            Send(bytes((paper.ANSWER,)) + own.public, way.back),
            Send(bytes((paper.HELLO,)) + other.public, way),
            self._note(way, now, "keys exchanged with the initiator", b"\1"),
        ]

    def _pass_on(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        ours = self._keys.get(way.receiver)
        opened = [
            frame for key in self._keys.get(way.sender, []) if (frame := paper.unseal(key, datagram)) is not None
        ]
        if not opened:
            return [Send(datagram, way)]  # from before he came
        if not ours:
            return []  # he shares no key with the receiver yet: as if it had been lost
        frame = opened[0]
        self.read += 1
        if self.read % 2:
            frame = _altered(frame)
            self.altered += 1
        size = paper.header_bytes(datagram)
        number = int.from_bytes(datagram[3:size], "big")
        note = self._note(way, now, "frame altered" if self.read % 2 else "frame read", datagram)
        return [Send(paper.seal(ours[0], number, frame), way), note]

    def _note(self, way: Way, now: float, detail: str, datagram: bytes) -> Intervention:
        kind = kind_of(datagram)
        number = 0 if kind is not Kind.ENVELOPE else self.read
        return Intervention(now, self.name, What.ALTERED, way, number, kind, len(datagram), detail)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """It has no addresses of its own."""
        return []

    def due(self, now: float) -> list[Action]:
        """It sends nothing by itself."""
        return []

    def next_deadline(self) -> float:
        """Never."""
        return NEVER


def _altered(frame: bytes) -> bytes:
    """The frame with its last field changed, and a checksum that fits."""
    message_id = int.from_bytes(frame[7:10], "little")
    payload = bytearray(frame[10 : 10 + frame[1]])
    payload[-2] ^= 0x40
    return mavlink_frame(message_id, bytes(payload), _CRC_EXTRA[message_id], frame[5], frame[4])
