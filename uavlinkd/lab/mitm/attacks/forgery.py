"""Attacks that alter or forge datagrams: flipped bits, changed lengths, joined parts, forged counters and frames."""

from __future__ import annotations

from collections import Counter
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.lab.mitm.anatomy import HANDSHAKE, DatagramKind, envelope_of, kind_of, mavlink_frame, with_mac1
from uavlinkd.lab.mitm.attack import (
    STRANGERS,
    Action,
    Alteration,
    AttackContext,
    Direction,
    Options,
    Timed,
    TimedOptions,
)
from uavlinkd.lab.mitm.kinds import KINDS, KindFilter, matches_kind


class ForgeryOptions(Options):
    """The parameters of alterations."""

    kinds: KindFilter = Field("envelope", description=KINDS)
    beside: bool = Field(False, description="also pass the genuine datagram, after the altered one")


class Forgery(Alteration[ForgeryOptions]):
    """An alteration of datagrams of the kinds in ``kinds``."""

    options_model: ClassVar[type[Options]] = ForgeryOptions

    def is_target(self, datagram: bytes) -> bool:
        """Datagrams of these kinds that are not empty."""
        return bool(datagram) and matches_kind(self.options.kinds, datagram)


class InTurn(Forgery):
    """An alteration that tries all positions or lengths in turn, for each kind separately."""

    def __init__(self, options: ForgeryOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._turns: Counter[DatagramKind] = Counter()

    def turn(self, datagram: bytes) -> int:
        """Count 0, 1, 2 and so on, for each kind of datagram."""
        kind = kind_of(datagram)
        self._turns[kind] += 1
        return self._turns[kind] - 1


class BitFlipOptions(ForgeryOptions):
    """The parameters of ``bit-flip``."""

    repair_mac1: bool = Field(False, description="compute a valid mac1, if the receiver's public key is known")


class BitFlip(InTurn):
    """Flips one bit, at all positions in turn."""

    name = "bit-flip"
    catalogue = ("H18", "D6")
    options_model = BitFlipOptions
    options: BitFlipOptions

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next bit: the first of each byte, then the second of each, and so on."""
        turn = self.turn(datagram)
        at, bit = turn % len(datagram), turn // len(datagram) % 8
        altered = bytearray(datagram)
        altered[at] ^= 1 << bit
        changed = bytes(altered)
        is_behind_macs = at >= len(datagram) - wire.MACS_BYTES
        if self.options.repair_mac1 and kind_of(changed) in HANDSHAKE and not is_behind_macs:
            changed = with_mac1(changed, self.context.public_keys.get(direction.receiver))
        return changed, f"bit {bit} of byte {at}"


class Truncate(InTurn):
    """Truncates datagrams by one byte, two bytes, and so on, until they are empty."""

    name = "truncate"
    catalogue = ("H18", "D7", "D15")

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next length."""
        cut = self.turn(datagram) % len(datagram) + 1
        return datagram[:-cut], f"{cut} bytes cut off"


class ExtendOptions(ForgeryOptions):
    """The parameters of ``extend``."""

    at_most: int = Field(64, ge=1, le=1400, description="maximum number of appended bytes")


class Extend(InTurn):
    """Appends bytes to datagrams: one, two, and so on."""

    name = "extend"
    catalogue = ("H18", "D8", "D15")
    options_model = ExtendOptions
    options: ExtendOptions

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next length."""
        more = self.turn(datagram) % self.options.at_most + 1
        return datagram + self.rng.randbytes(more), f"{more} bytes appended"


class SpliceOptions(ForgeryOptions):
    """The parameters of ``splice``."""

    join: Literal["all", "body", "header", "tag", "both"] = Field(
        "all",
        description="the part of the envelope before that replaces this one's: body and tag, header, tag; both: this"
        " one is appended to the one before; all: each in turn",
    )


class Splice(InTurn):
    """Joins parts of two envelopes: header and body of different ones, swapped tags, two in one datagram."""

    name = "splice"
    catalogue = ("D6", "D8")
    options_model = SpliceOptions
    options: SpliceOptions

    def __init__(self, options: SpliceOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._last: dict[Direction, bytes] = {}
        self._before: bytes | None = None

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Record the last envelope of each direction."""
        self._before = None
        if envelope_of(datagram) is not None:
            self._before = self._last.get(direction)
            self._last[direction] = datagram

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes that follow a different envelope."""
        return envelope_of(datagram) is not None and self._before is not None and self._before != datagram

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next kind of join."""
        before, this = self._before, envelope_of(datagram)
        assert before is not None
        assert this is not None
        other = envelope_of(before)
        assert other is not None
        joins = ["body", "header", "tag", "both"] if self.options.join == "all" else [self.options.join]
        join = joins[self.turn(datagram) % len(joins)]
        match join:
            case "body":
                spliced = datagram[: this.header_bytes] + before[other.header_bytes :]
            case "header":
                spliced = before[: other.header_bytes] + datagram[this.header_bytes :]
            case "tag":
                # The length of the shortest tag. Of a longer tag, this replaces the last bytes.
                spliced = datagram[: -wire.TAG_LENGTHS[0]] + before[-wire.TAG_LENGTHS[0] :]
            case _:
                spliced = datagram + before
        return spliced, f"{join} of envelope {other.counter} in envelope {this.counter}"


class CounterOptions(ForgeryOptions):
    """The parameters of ``counter-jump``. The genuine envelope passes too: a moved replay window would show."""

    beside: bool = Field(True, description="also pass the genuine datagram, after the altered one")
    to: Literal["random", "last", "ahead", "back"] = Field(
        "random", description="any counter, the last valid one (2^32-2), a little ahead, or a used one"
    )


class CounterJump(Forgery):
    """Alters the counter of envelopes: to the last valid one, far ahead, a little ahead, or back."""

    name = "counter-jump"
    catalogue = ("D5", "D17")
    options_model = CounterOptions
    options: CounterOptions

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with a complete header."""
        return envelope_of(datagram) is not None

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """Replace the counter, in the encoding that fits it."""
        envelope = envelope_of(datagram)
        assert envelope is not None
        old = envelope.counter
        match self.options.to:
            case "last":
                new = c.SESSION_ENVELOPE_LIMIT - 1
            case "ahead":
                new = old + self.rng.randrange(1, 1000)
            case "back":
                new = old - self.rng.randrange(1, 100)
            case _:
                new = self.rng.randrange(c.SESSION_ENVELOPE_LIMIT)
        new %= c.SESSION_ENVELOPE_LIMIT
        if new == old:
            new = old ^ 1
        header = wire.envelope_header(envelope.receiver_index, new)
        return header + datagram[envelope.header_bytes :], f"counter {old} to {new}"


class AlterFrame(Forgery):
    """Alters the payload of envelopes, but not the header and the tag."""

    name = "alter-frame"
    catalogue = ("D6",)

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with a payload, for any length of the tag."""
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) > envelope.header_bytes + wire.TAG_LENGTHS[-1]

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """Alter one byte."""
        envelope = envelope_of(datagram)
        assert envelope is not None
        at = self.rng.randrange(envelope.header_bytes, len(datagram) - wire.TAG_LENGTHS[-1])
        altered = bytearray(datagram)
        altered[at] ^= self.rng.randrange(1, 256)
        return bytes(altered), f"byte {at} of envelope {envelope.counter}"


class TagOptions(ForgeryOptions):
    """The parameters of ``tamper-tag``."""

    tag: Literal["all", "zero", "random", "short", "long", "none"] = Field(
        "all", description="zeros, random bytes, 8 bytes, 32 bytes, or without a tag; all: each in turn"
    )


class TamperTag(InTurn):
    """Alters the tag of envelopes: zeros, random bytes, another length, or no tag."""

    name = "tamper-tag"
    catalogue = ("D6", "D7")
    options_model = TagOptions
    options: TagOptions

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with at least 16 bytes after the header."""
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) >= envelope.header_bytes + 16

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next change, for a tag of the default length of 16 bytes."""
        tags = ["zero", "random", "short", "long", "none"] if self.options.tag == "all" else [self.options.tag]
        kind = tags[self.turn(datagram) % len(tags)]
        head, tag = datagram[:-16], datagram[-16:]
        match kind:
            case "zero" if any(tag):
                altered = head + bytes(16)
            case "short":
                altered = head + tag[:8]
            case "long":
                altered = datagram + self.rng.randbytes(16)
            case "none":
                altered = head
            case _:
                first = self.rng.randrange(1, 256) ^ tag[0]
                altered = head + bytes((first,)) + self.rng.randbytes(15)
        return altered, f"tag {kind}"


# Injected frames.

COMMAND_FRAMES: tuple[tuple[str, bytes], ...] = (
    # HEARTBEAT 0: custom mode u32, type 6 (ground station), autopilot 8, base mode, status 4, version 3.
    ("HEARTBEAT", mavlink_frame(0, bytes((0, 0, 0, 0, 6, 8, 192, 4, 3)), 50)),
    # COMMAND_LONG 76: seven floats, command u16, target system and component, confirmation.
    ("disarm", mavlink_frame(76, bytes(28) + (400).to_bytes(2, "little") + bytes((1, 1, 0)), 152)),
    ("flight termination", mavlink_frame(76, b"\0\0\x80?" + bytes(24) + (185).to_bytes(2, "little") + b"\1\1", 152)),
    # SET_MODE 11: custom mode u32, target system, base mode.
    ("SET_MODE", mavlink_frame(11, bytes((6, 0, 0, 0, 1, 1)), 89)),
)
"""Name and frame, for an attacker that wants to bring the drone down."""


class OriginOptions(TimedOptions):
    """The parameters of injected frames."""

    origin: Literal["sender", "stranger", "both"] = Field(
        "both", description="source: a peer's address, strangers, or both in turn"
    )
    sources: int = Field(16, ge=1, le=STRANGERS, description="number of strangers that send")


class FromAnywhere(Timed[OriginOptions]):
    """An attack that injects datagrams from a peer's address or from strangers."""

    options_model: ClassVar[type[Options]] = OriginOptions

    def origin(self) -> int | None:
        """The source: a stranger, or None for the peer's address."""
        # Alternate per direction, because directions alternate too and their number is even.
        is_turn = self.sent_count // len(self.directions) % 2 == 1
        is_stranger = self.options.origin == "stranger" or (self.options.origin == "both" and is_turn)
        return self.rng.randrange(self.options.sources) if is_stranger else None


class RawMavlink(FromAnywhere):
    """Sends bare MAVLink frames to the peers' ports: disarm, flight termination, mode changes, heartbeats."""

    name = "raw-mavlink"
    catalogue = ("D12",)

    def send_next(self, now: float) -> list[Action]:
        """Inject the next frame in the next direction."""
        name, frame = COMMAND_FRAMES[self.sent_count // (2 * len(self.directions)) % len(COMMAND_FRAMES)]
        return self.inject(frame, self.directions[self.sent_count % len(self.directions)], now, name, self.origin())


class ForgeData(FromAnywhere):
    """Injects forged envelopes: valid session index, a coming counter, a command, a random tag."""

    name = "forge-data"
    catalogue: ClassVar[tuple[str, ...]] = ("D5", "D6", "D16")

    def __init__(self, options: OriginOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._newest: dict[Direction, tuple[int, int]] = {}

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Record the session in use and its counter."""
        envelope = envelope_of(datagram)
        if envelope is not None:
            self._newest[direction] = envelope.receiver_index, envelope.counter

    def send_next(self, now: float) -> list[Action]:
        """Inject one envelope in the next direction that has a session."""
        directions = [direction for direction in self.directions if direction in self._newest]
        if not directions:
            return []
        direction = directions[self.sent_count % len(directions)]
        index, counter = self._newest[direction]
        counter = (counter + self.rng.randrange(1, 64)) % c.SESSION_ENVELOPE_LIMIT
        name, frame = COMMAND_FRAMES[self.rng.randrange(len(COMMAND_FRAMES))]
        datagram = wire.envelope_header(index, counter) + frame + self.rng.randbytes(16)
        return self.inject(datagram, direction, now, f"{name} as envelope {counter}", self.origin())


class FloodEnvelopesOptions(OriginOptions):
    """The defaults are a higher rate and more strangers."""

    rate_per_s: float = Field(1000.0, gt=0, le=100_000, description="datagrams per second")
    sources: int = Field(64, ge=1, le=STRANGERS, description="number of strangers that send")


class FloodEnvelopes(ForgeData):
    """Floods with envelopes that are valid except for the tag."""

    name = "flood-envelopes"
    catalogue = ("D16",)
    options_model = FloodEnvelopesOptions
