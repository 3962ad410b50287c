"""Attacks that send by themselves: floods from many addresses, probes for answers, false cookies and hints."""

from __future__ import annotations

from collections import Counter, deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.core import wire
from uavlinkd.core.constants import MAC_BYTES
from uavlinkd.core.suites import SUITES, X25519, Suite
from uavlinkd.lab.mitm.amplification import Amplification
from uavlinkd.lab.mitm.anatomy import Kind, initiation, kind_of
from uavlinkd.lab.mitm.attack import (
    STRANGERS,
    Action,
    Attack,
    AttackError,
    Options,
    Send,
    Surroundings,
    Timed,
    TimedOptions,
    Way,
    What,
)

RECORD_LIMIT = 4096
"""Initiations kept to be replayed."""


class FloodOptions(TimedOptions):
    """How fast, and from how many addresses."""

    rate_per_s: float = Field(500.0, gt=0, le=100_000, description="datagrams a second")
    sources: int = Field(
        64, ge=0, le=STRANGERS, description="how many addresses of its own; 0: under the other peer's address"
    )


class Flood(Timed[FloodOptions]):
    """What floods share: addresses, and a look at the answers."""

    options_model: ClassVar[type[Options]] = FloodOptions

    def __init__(self, options: FloodOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self.answers: Counter[Kind] = Counter()
        """What the peers sent back to addresses of ours."""

    def shoot(self, now: float) -> list[Action]:
        """One datagram along the next way, from the next address."""
        way = self.ways[self.shots % len(self.ways)]
        made = self.make(way)
        if made is None:
            return []
        datagram, detail = made
        stranger = None if self.options.sources == 0 else self.chance.randrange(self.options.sources)
        return self.inject(datagram, way, now, detail, stranger)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Note it: cookies are expected under load, nothing else is."""
        self.answers[kind_of(datagram)] += 1
        way = next((each for each in self.ways if each.receiver == peer), self.ways[0]).back
        return [self.note(What.ANSWERED, datagram, way, now, f"to stranger {stranger}", own=True)]

    def make(self, way: Way) -> tuple[bytes, str] | None:
        """The next datagram, and what it is; None where there is none to send."""
        raise NotImplementedError


class FloodInitiationsOptions(FloodOptions):
    """Of ``flood-initiations``."""

    mac1: Literal["valid", "bad"] = Field("valid", description="valid takes the receiver's public key")
    suite: str = Field("x25519", description="the suite that they name")


class FloodInitiations(Flood):
    """Floods with initiations of its own making, with a valid mac1 or a bad one, from many addresses."""

    name = "flood-initiations"
    catalogue = ("H12",)
    options_model = FloodInitiationsOptions
    options: FloodInitiationsOptions

    def __init__(
        self, options: FloodInitiationsOptions, surroundings: Surroundings, chance: Random, now: float
    ) -> None:
        super().__init__(options, surroundings, chance, now)
        named = [suite for suite in SUITES.values() if suite.name == options.suite]
        if not named:
            raise AttackError(f"suite is one of {', '.join(suite.name for suite in SUITES.values())}")
        self._suite = named[0]
        receivers = {way.receiver for way in self.ways}
        if options.mac1 == "valid" and not receivers <= set(surroundings.public_keys):
            raise AttackError(f"{self.name} with a valid mac1 takes the receivers' public keys: configure public_key")

    def make(self, way: Way) -> tuple[bytes, str]:
        """One with a key exchange that leads nowhere."""
        key = self.surroundings.public_keys[way.receiver] if self.options.mac1 == "valid" else None
        return random_initiation(self.chance, self._suite, key), f"{self.options.mac1} mac1"


class FloodReplays(Flood):
    """Floods with initiations that were recorded, from many addresses."""

    name = "flood-replays"
    catalogue = ("H3", "H12")

    def __init__(self, options: FloodOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._recorded: dict[Way, deque[bytes]] = {way: deque(maxlen=RECORD_LIMIT) for way in self.ways}

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """Keep initiations."""
        if kind_of(datagram) is Kind.INITIATION:
            self._recorded[way].append(datagram)

    def make(self, way: Way) -> tuple[bytes, str] | None:
        """Any of them."""
        recorded = self._recorded[way]
        return (self.chance.choice(recorded), f"one of {len(recorded)}") if recorded else None


_HOSTILE_TEXT = (
    b'\x1b]0;owned\x07\x1b[2J"}\n{"event": "session_established", "peer": "attacker"}\r\n',
    b"%s%n%x ${jndi:ldap://[::1]/} \xff\xfe\x00 ../../etc/passwd\n" * 4,
)
"""What a log or a terminal might take for its own."""


class FloodGarbage(Flood):
    """Floods with random bytes of every length, nothing at all, and text that would forge log lines."""

    name = "flood-garbage"
    catalogue = ("H21", "D15", "D21")

    def make(self, way: Way) -> tuple[bytes, str]:
        """Now this, now that."""
        match self.shots // 2 % 4:
            case 0:
                return b"", "empty"
            case 1:
                return self.chance.choice(_HOSTILE_TEXT), "text"
            case 2:  # a first byte that means something
                kind = self.chance.choice((1, 2, 3, 0x40, 0x41, 0xFD, 0xFE))
                return bytes((kind,)) + self.chance.randbytes(self.chance.randrange(1400)), "garbage behind a type"
            case _:
                return self.chance.randbytes(self.chance.randrange(1, 1400)), "garbage"


class ScanOptions(FloodOptions):
    """Slower, from few addresses."""

    rate_per_s: float = Field(200.0, gt=0, le=100_000, description="datagrams a second")
    sources: int = Field(4, ge=1, le=STRANGERS, description="how many addresses of its own")


class StrangerScan(Flood):
    """Looks for an answer as a port scanner does: every first byte, at lengths that mean something."""

    name = "stranger-scan"
    catalogue = ("H21",)
    options_model = ScanOptions

    def make(self, way: Way) -> tuple[bytes, str]:
        """The next first byte; the next length when all have been."""
        lengths = (1, 5, 13, wire.COOKIE_BYTES, wire.response_bytes(X25519), wire.initiation_bytes(X25519), 1232)
        number = self.shots // len(self.ways)
        kind, length = number % 256, lengths[number // 256 % len(lengths)]
        # The second byte is zero, as a suite and as a cookie reply have it.
        return (bytes((kind, 0)) + self.chance.randbytes(length))[:length], f"type {kind:#04x}"


class ProbeOptions(ScanOptions):
    """As fast as makes the peer ask for cookies."""

    rate_per_s: float = Field(300.0, gt=0, le=100_000, description="datagrams a second")


class AmplificationProbe(Flood):
    """Sends whatever might be answered, as short as it can be, and counts the bytes that come back."""

    name = "amplification-probe"
    catalogue = ("H13", "H21")
    options_model = ProbeOptions

    def __init__(self, options: ProbeOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._recorded: dict[Way, deque[bytes]] = {way: deque(maxlen=64) for way in self.ways}
        self._amplification = Amplification()

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """Keep a few of everything."""
        self._recorded[way].append(datagram)

    def make(self, way: Way) -> tuple[bytes, str]:
        """Now an initiation of ours, now something recorded, now something cut short."""
        recorded = self._recorded[way]
        key = self.surroundings.public_keys.get(way.receiver)
        turn = self.shots // len(self.ways) % 4  # of this way: they are taken in turn too
        if recorded and turn == 1:
            return self.chance.choice(recorded), "recorded"
        if recorded and turn == 3:
            datagram = self.chance.choice(recorded)
            return datagram[: self.chance.randrange(len(datagram) + 1)], "recorded, cut short"
        return random_initiation(self.chance, X25519, key), "initiation"

    def inject(
        self, datagram: bytes, way: Way, now: float, detail: str = "", stranger: int | None = None
    ) -> list[Action]:
        """And count."""
        if stranger is not None:
            self._amplification.sent(way.receiver, stranger, len(datagram), now)
        return super().inject(datagram, way, now, detail, stranger)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Count, and tell where more came back than went there."""
        self._amplification.came_back(peer, stranger, len(datagram), now)
        actions = super().on_answer(datagram, peer, stranger, now)
        if (peer, stranger) in self.amplified:
            way = next((each for each in self.ways if each.receiver == peer), self.ways[0]).back
            actions.append(self.note(What.ANSWERED, datagram, way, now, "amplified: more than was sent", own=True))
        return actions

    @property
    def amplified(self) -> list[tuple[str, int]]:
        """Peers and strangers between whom more came back than went there."""
        return list(self._amplification.excess)


class HintsOptions(FloodOptions):
    """Under the peer's address: only there it is a hint."""

    rate_per_s: float = Field(100.0, gt=0, le=100_000, description="datagrams a second")
    sources: int = Field(0, ge=0, le=STRANGERS, description="0: under the other peer's address, where they are hints")


class ForgeHints(Flood):
    """Sends envelopes for sessions that nobody has, so that a peer believes that it restarted."""

    name = "forge-hints"
    catalogue = ("H16",)
    options_model = HintsOptions

    def make(self, way: Way) -> tuple[bytes, str]:
        """An index by chance."""
        index = self.chance.randrange(1, 2**16)
        header = wire.envelope_header(index, self.chance.randrange(2**16))
        return header + self.chance.randbytes(32), f"index {index}"


class ForgeCookieOptions(Options):
    """How many for each message."""

    copies: int = Field(1, ge=1, le=100, description="false cookies for each handshake message")


class ForgeCookie(Attack[ForgeCookieOptions]):
    """Answers handshake messages with false cookie replies that name the right index, faster than the peer.

    The cookie in them does not open: to seal one takes ChaCha20-Poly1305 besides the public key, and this package has
    no cryptography beyond ``mac1``.
    """

    name = "forge-cookie"
    catalogue = ("H19",)
    options_model = ForgeCookieOptions

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Let it pass, and answer it."""
        actions: list[Action] = [Send(datagram, way)]
        if (
            kind_of(datagram) not in (Kind.INITIATION, Kind.RESPONSE)
            or len(datagram) < 4
            or way.back not in (self.surroundings.ways)
        ):
            return actions
        if not self.strikes_now():
            return actions
        index = int.from_bytes(datagram[2:4], "big")
        for _ in range(self.options.copies):
            nonce, sealed = self.chance.randbytes(16), self.chance.randbytes(MAC_BYTES + 16)
            reply = wire.encode_cookie_reply(index, nonce, sealed)
            actions.append(Send(reply, way.back))
            actions.append(
                self.note(What.INJECTED, reply, way.back, now, f"false cookie for index {index}", own=True)
            )
        return actions


def random_initiation(chance: Random, suite: Suite, public_key: bytes | None) -> bytes:
    """An initiation of random bytes; with a valid ``mac1`` where the key is given."""
    noise = chance.randbytes(wire.initiation_bytes(suite))
    return initiation(suite, chance.randrange(1, 2**16), noise, public_key)
