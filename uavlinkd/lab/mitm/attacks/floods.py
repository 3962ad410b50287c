"""Attacks that inject datagrams: floods from many addresses, probes for answers, forged cookies and hints."""

from __future__ import annotations

from collections import Counter, deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.core import wire
from uavlinkd.core.constants import MAC_BYTES
from uavlinkd.core.suites import SUITES, X25519, Suite
from uavlinkd.lab.mitm.amplification import Amplification
from uavlinkd.lab.mitm.anatomy import DatagramKind, initiation, kind_of
from uavlinkd.lab.mitm.attack import (
    STRANGERS,
    Action,
    Attack,
    AttackContext,
    AttackError,
    Direction,
    Operation,
    Options,
    Send,
    Timed,
    TimedOptions,
)

RECORD_LIMIT = 4096
"""Initiations recorded for a replay."""


class FloodOptions(TimedOptions):
    """The parameters of floods."""

    rate_per_s: float = Field(500.0, gt=0, le=100_000, description="datagrams per second")
    sources: int = Field(
        64, ge=0, le=STRANGERS, description="number of strangers that send; 0: send from the other peer's address"
    )


class Flood(Timed[FloodOptions]):
    """The base class of floods. It counts the answers."""

    options_model: ClassVar[type[Options]] = FloodOptions

    def __init__(self, options: FloodOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self.answers: Counter[DatagramKind] = Counter()
        """Datagrams that the peers sent to strangers."""

    def send_next(self, now: float) -> list[Action]:
        """Inject one datagram in the next direction, from the next address."""
        direction = self.directions[self.sent_count % len(self.directions)]
        result = self.make(direction)
        if result is None:
            return []
        datagram, detail = result
        stranger = None if self.options.sources == 0 else self.rng.randrange(self.options.sources)
        return self.inject(datagram, direction, now, detail, stranger)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Count and log the answer: only cookies are expected, under load."""
        self.answers[kind_of(datagram)] += 1
        direction = self.answer_direction(peer)
        return [self.note(Operation.ANSWERED, datagram, direction, now, f"to stranger {stranger}", own=True)]

    def answer_direction(self, peer: str) -> Direction:
        """The direction in the log of an answer from ``peer``."""
        return next((one for one in self.directions if one.receiver == peer), self.directions[0]).reverse

    def make(self, direction: Direction) -> tuple[bytes, str] | None:
        """The next datagram and its description; None if there is nothing to send yet."""
        raise NotImplementedError


class FloodInitiationsOptions(FloodOptions):
    """The parameters of ``flood-initiations``."""

    mac1: Literal["valid", "bad"] = Field("valid", description="valid needs the receiver's public key")
    suite: str = Field("x25519", description="the suite in the initiations")


class FloodInitiations(Flood):
    """Floods with random initiations, with a valid or bad mac1, from many addresses."""

    name = "flood-initiations"
    catalogue = ("H12",)
    options_model = FloodInitiationsOptions
    options: FloodInitiationsOptions

    def __init__(self, options: FloodInitiationsOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        named = [suite for suite in SUITES.values() if suite.name == options.suite]
        if not named:
            raise AttackError(f"suite must be one of {', '.join(suite.name for suite in SUITES.values())}")
        self._suite = named[0]
        receivers = {direction.receiver for direction in self.directions}
        if options.mac1 == "valid" and not receivers <= set(context.public_keys):
            raise AttackError(f"{self.name} with a valid mac1 needs the receivers' public keys: configure public_key")

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """An initiation with random content."""
        key = self.context.public_keys[direction.receiver] if self.options.mac1 == "valid" else None
        return random_initiation(self.rng, self._suite, key), f"{self.options.mac1} mac1"


class FloodReplays(Flood):
    """Floods with recorded initiations, from many addresses."""

    name = "flood-replays"
    catalogue = ("H3", "H12")

    def __init__(self, options: FloodOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._recorded: dict[Direction, deque[bytes]] = {
            direction: deque(maxlen=RECORD_LIMIT) for direction in self.directions
        }

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Record initiations."""
        if kind_of(datagram) is DatagramKind.INITIATION:
            self._recorded[direction].append(datagram)

    def make(self, direction: Direction) -> tuple[bytes, str] | None:
        """A random recorded initiation."""
        recorded = self._recorded[direction]
        return (self.rng.choice(recorded), f"one of {len(recorded)}") if recorded else None


_HOSTILE_TEXT = (
    b'\x1b]0;owned\x07\x1b[2J"}\n{"event": "session_established", "peer": "attacker"}\r\n',
    b"%s%n%x ${jndi:ldap://[::1]/} \xff\xfe\x00 ../../etc/passwd\n" * 4,
)
"""Text that a log reader or a terminal might interpret."""


class FloodGarbage(Flood):
    """Floods with random bytes, empty datagrams, and text that would forge log lines."""

    name = "flood-garbage"
    catalogue = ("H21", "D15", "D21")

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """The next type of garbage."""
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


class ScanOptions(FloodOptions):
    """The defaults are a lower rate and fewer addresses."""

    rate_per_s: float = Field(200.0, gt=0, le=100_000, description="datagrams per second")
    sources: int = Field(4, ge=1, le=STRANGERS, description="how many addresses of its own")


class StrangerScan(Flood):
    """Looks for an answer like a port scanner: every first byte, in datagrams of valid lengths."""

    name = "stranger-scan"
    catalogue = ("H21",)
    options_model = ScanOptions

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """The next first byte; after all of them, the next length."""
        lengths = (1, 5, 13, wire.COOKIE_BYTES, wire.response_bytes(X25519), wire.initiation_bytes(X25519), 1232)
        number = self.sent_count // len(self.directions)
        kind, length = number % 256, lengths[number // 256 % len(lengths)]
        # The second byte is zero: a valid suite, and valid in a cookie reply.
        return (bytes((kind, 0)) + self.rng.randbytes(length))[:length], f"type {kind:#04x}"


class ProbeOptions(ScanOptions):
    """The default rate makes the peer require cookies."""

    rate_per_s: float = Field(300.0, gt=0, le=100_000, description="datagrams per second")


class AmplificationProbe(Flood):
    """Sends short datagrams that a peer might answer, and counts the bytes of the answers."""

    name = "amplification-probe"
    catalogue = ("H13", "H21")
    options_model = ProbeOptions

    def __init__(self, options: ProbeOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._recorded: dict[Direction, deque[bytes]] = {direction: deque(maxlen=64) for direction in self.directions}
        self._amplification = Amplification()

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Record the newest datagrams."""
        self._recorded[direction].append(datagram)

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """An initiation, a recorded datagram, or a truncated one, in turn."""
        recorded = self._recorded[direction]
        key = self.context.public_keys.get(direction.receiver)
        turn = self.sent_count // len(self.directions) % 4  # per direction, because directions alternate too
        if recorded and turn == 1:
            return self.rng.choice(recorded), "recorded"
        if recorded and turn == 3:
            datagram = self.rng.choice(recorded)
            return datagram[: self.rng.randrange(len(datagram) + 1)], "recorded, truncated"
        return random_initiation(self.rng, X25519, key), "initiation"

    def inject(
        self, datagram: bytes, direction: Direction, now: float, detail: str = "", stranger: int | None = None
    ) -> list[Action]:
        """Count the sent bytes."""
        if stranger is not None:
            self._amplification.sent(direction.receiver, stranger, len(datagram), now)
        return super().inject(datagram, direction, now, detail, stranger)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Count the received bytes, and log an amplification."""
        self._amplification.received(peer, stranger, len(datagram), now)
        actions = super().on_answer(datagram, peer, stranger, now)
        if (peer, stranger) in self.amplified:
            direction = self.answer_direction(peer)
            actions.append(
                self.note(
                    Operation.ANSWERED, datagram, direction, now, "amplified: more bytes than were sent", own=True
                )
            )
        return actions

    @property
    def amplified(self) -> list[tuple[str, int]]:
        """Peers and strangers where the stranger received more than it sent."""
        return list(self._amplification.excess)


class HintsOptions(FloodOptions):
    """The default source is the peer's address: hints are valid only from there."""

    rate_per_s: float = Field(100.0, gt=0, le=100_000, description="datagrams per second")
    sources: int = Field(
        0,
        ge=0,
        le=STRANGERS,
        description="number of strangers that send; 0: send from the other peer's address, as hints need",
    )


class ForgeHints(Flood):
    """Sends envelopes for unknown sessions, so that a peer believes that the other lost its session."""

    name = "forge-hints"
    catalogue = ("H16",)
    options_model = HintsOptions

    def make(self, direction: Direction) -> tuple[bytes, str]:
        """An envelope with a random index."""
        index = self.rng.randrange(1, 2**16)
        header = wire.envelope_header(index, self.rng.randrange(2**16))
        return header + self.rng.randbytes(32), f"index {index}"


class ForgeCookieOptions(Options):
    """The parameters of ``forge-cookie``."""

    copies: int = Field(1, ge=1, le=100, description="forged cookies for each handshake message")


class ForgeCookie(Attack[ForgeCookieOptions]):
    """Answers handshake messages with forged cookie replies that have the right index, before the peer answers.

    The cookies cannot be decrypted: that needs ChaCha20-Poly1305, and this package computes only ``mac1``.
    """

    name = "forge-cookie"
    catalogue = ("H19",)
    options_model = ForgeCookieOptions

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Pass the datagram and answer it."""
        actions: list[Action] = [Send(datagram, direction)]
        if (
            kind_of(datagram) not in (DatagramKind.INITIATION, DatagramKind.RESPONSE)
            or len(datagram) < 4
            or direction.reverse not in (self.context.directions)
        ):
            return actions
        if not self.should_attack():
            return actions
        index = int.from_bytes(datagram[2:4], "big")
        for _ in range(self.options.copies):
            nonce, sealed = self.rng.randbytes(16), self.rng.randbytes(MAC_BYTES + 16)
            reply = wire.encode_cookie_reply(index, nonce, sealed)
            actions.append(Send(reply, direction.reverse))
            actions.append(
                self.note(
                    Operation.INJECTED, reply, direction.reverse, now, f"forged cookie for index {index}", own=True
                )
            )
        return actions


def random_initiation(rng: Random, suite: Suite, public_key: bytes | None) -> bytes:
    """An initiation of random bytes. With a key, its ``mac1`` is valid."""
    noise = rng.randbytes(wire.initiation_bytes(suite))
    return initiation(suite, rng.randrange(1, 2**16), noise, public_key)
