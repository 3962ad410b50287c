"""Attacks that inject datagrams: floods from many addresses, probes for answers, forged cookies and hints."""

from __future__ import annotations

from collections import deque

from uavlinkd.lab.mitm.anatomy import HANDSHAKE, kind_of, random_initiation
from uavlinkd.lab.mitm.attack import Action, Attack, AttackError, Direction, Operation, Send, Timed
from uavlinkd.protocol import wire
from uavlinkd.protocol.constants import MAC_BYTES
from uavlinkd.protocol.suites import X25519

RECORD_LIMIT = 4096


class Flood(Timed, rate_per_s=500.0, sources=64):
    """The base class of floods."""

    def send_next(self, now: float) -> list[Action]:
        """Inject one datagram in the next direction, from the next address."""
        direction = self.directions[self.sent_count % len(self.directions)]
        result = self.make(direction)
        if result is None:
            return []
        stranger = None if self.options.sources == 0 else self.rng.randrange(self.options.sources)
        return self.inject(result[0], direction, now, result[1], stranger)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Log the answer: only cookies are expected, under load."""
        asked = next((one for one in self.directions if one.receiver == peer), self.directions[0])
        return [self.own(Operation.ANSWERED, datagram, asked.reverse, now, f"to stranger {stranger}")]

    def make(self, direction: Direction) -> tuple[bytes, str] | None:
        """The next datagram and its description; None if there is nothing to send yet."""
        raise NotImplementedError


class FloodInitiations(Flood, name="flood-initiations", mac1="valid", certificate=False):
    """Floods with random initiations, with a valid or bad mac1, from many addresses."""

    def prepare(self) -> None:
        super().prepare()
        receivers = {direction.receiver for direction in self.directions}
        if self.options.mac1 == "valid" and not receivers <= set(self.context.public_keys):
            raise AttackError(f"{self.name} with a valid mac1 needs the receivers' public keys: configure public_key")

    def make(self, direction: Direction) -> tuple[bytes, str]:
        key = self.context.public_keys[direction.receiver] if self.options.mac1 == "valid" else None
        more = wire.CERTIFICATE_BYTES if self.options.certificate else 0
        return random_initiation(self.rng, X25519, key, more), f"{self.options.mac1} mac1"


_HOSTILE_TEXT = (
    b'\x1b]0;owned\x07\x1b[2J"}\n{"event": "session_established", "peer": "attacker"}\r\n',
    b"%s%n%x ${jndi:ldap://[::1]/} \xff\xfe\x00 ../../etc/passwd\n" * 4,
)
"""Text that a log reader or a terminal might interpret."""


class FloodGarbage(Flood, name="flood-garbage"):
    """Floods with random bytes, empty datagrams, and text that would forge log lines."""

    def make(self, direction: Direction) -> tuple[bytes, str]:
        match self.sent_count // 2 % 4:
            case 0:
                return b"", "empty"
            case 1:
                return self.rng.choice(_HOSTILE_TEXT), "text"
            case 2:  # a valid first byte
                kind = self.rng.choice((1, 2, 3, 0x40, 0x41, 0xFD, 0xFE))
                return bytes((kind,)) + self.rng.randbytes(self.rng.randrange(1400)), "garbage behind a type"
            case _:
                return self.rng.randbytes(self.rng.randrange(1, 1400)), "garbage"


class AmplificationProbe(Flood, name="amplification-probe", rate_per_s=300.0, sources=4):
    """Sends short datagrams that a peer might answer. The statistics have the bytes of longer answers.

    The rate makes the peer require cookies.
    """

    def prepare(self) -> None:
        super().prepare()
        self._recorded = {direction: deque[bytes](maxlen=64) for direction in self.directions}

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        self._recorded[direction].append(datagram)

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """An initiation, a recorded datagram, or a truncated one, in turn."""
        recorded = self._recorded[direction]
        turn = self.sent_count // len(self.directions) % 4  # per direction, because directions alternate too
        if recorded and turn == 1:
            return self.rng.choice(recorded), "recorded"
        if recorded and turn == 3:
            datagram = self.rng.choice(recorded)
            return datagram[: self.rng.randrange(len(datagram) + 1)], "recorded, truncated"
        key = self.context.public_keys.get(direction.receiver)
        return random_initiation(self.rng, X25519, key), "initiation"


class ForgeHints(Flood, name="forge-hints", rate_per_s=100.0, sources=0):
    """Sends envelopes for unknown sessions, so that a peer believes that the other lost its session."""

    def make(self, direction: Direction) -> tuple[bytes, str]:
        index = self.rng.randrange(1, 2**16)
        header = wire.envelope_header(index, self.rng.randrange(2**16))
        return header + self.rng.randbytes(32), f"index {index}"


class ForgeCookie(Attack, name="forge-cookie", copies=1):
    """Answers handshake messages with forged cookie replies that have the right index, before the peer answers.

    The cookies cannot be decrypted: that needs ChaCha20-Poly1305, and this package computes only ``mac1``.
    """

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        actions: list[Action] = [Send(datagram, direction)]
        back = direction.reverse
        is_target = kind_of(datagram) in HANDSHAKE and len(datagram) >= 4 and back in self.context.directions
        if not is_target or not self.should_attack():
            return actions
        index = int.from_bytes(datagram[2:4], "big")
        for _ in range(self.options.copies):
            reply = wire.encode_cookie_reply(index, self.rng.randbytes(16), self.rng.randbytes(MAC_BYTES + 16))
            note = self.own(Operation.INJECTED, reply, back, now, f"forged cookie for index {index}")
            actions += [Send(reply, back), note]
        return actions
