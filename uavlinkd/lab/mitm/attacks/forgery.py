"""Attacks on datagrams and envelopes: bits flipped, lengths changed, parts joined, counters and frames forged."""

from __future__ import annotations

from collections import Counter
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.lab.mitm.anatomy import HANDSHAKE, Kind, envelope_of, kind_of, mavlink_frame, with_mac1
from uavlinkd.lab.mitm.attack import (
    STRANGERS,
    Action,
    Alteration,
    Kinds,
    Options,
    Surroundings,
    Timed,
    TimedOptions,
    Way,
    is_of,
)


class ForgeryOptions(Options):
    """Which datagrams, and whether the genuine one passes too."""

    kinds: Kinds = Field("envelope", description="any, handshake, initiation, response, cookie or envelope")
    beside: bool = Field(False, description="let the genuine datagram pass too, behind the altered one")


class Forgery(Alteration[ForgeryOptions]):
    """A change of datagrams of the kinds that the parameter names."""

    options_model: ClassVar[type[Options]] = ForgeryOptions

    def is_target(self, datagram: bytes) -> bool:
        """Those that have a byte to change."""
        return bool(datagram) and is_of(self.options.kinds, datagram)


class InTurn(Forgery):
    """A change that goes through all places or lengths, one after the other, for each kind by itself."""

    def __init__(self, options: ForgeryOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._turns: Counter[Kind] = Counter()

    def turn(self, datagram: bytes) -> int:
        """0, 1, 2 and so on, for each kind of datagram."""
        kind = kind_of(datagram)
        self._turns[kind] += 1
        return self._turns[kind] - 1


class BitFlipOptions(ForgeryOptions):
    """Of ``bit-flip``."""

    repair_mac1: bool = Field(False, description="make mac1 fit again, where the receiver's public key is known")


class BitFlip(InTurn):
    """Flips one bit, at every position in turn."""

    name = "bit-flip"
    catalogue = ("H18", "D6")
    options_model = BitFlipOptions
    options: BitFlipOptions

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """The next bit: the first of each byte, then the second of each, and so on."""
        turn = self.turn(datagram)
        at, bit = turn % len(datagram), turn // len(datagram) % 8
        altered = bytearray(datagram)
        altered[at] ^= 1 << bit
        changed = bytes(altered)
        is_behind_macs = at >= len(datagram) - wire.MACS_BYTES
        if self.options.repair_mac1 and kind_of(changed) in HANDSHAKE and not is_behind_macs:
            changed = with_mac1(changed, self.surroundings.public_keys.get(way.receiver))
        return changed, f"bit {bit} of byte {at}"


class Truncate(InTurn):
    """Cuts datagrams short, by one byte, by two, and so on, down to nothing."""

    name = "truncate"
    catalogue = ("H18", "D7", "D15")

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """The next length."""
        cut = self.turn(datagram) % len(datagram) + 1
        return datagram[:-cut], f"{cut} bytes cut off"


class ExtendOptions(ForgeryOptions):
    """Of ``extend``."""

    at_most: int = Field(64, ge=1, le=1400, description="bytes put behind")


class Extend(InTurn):
    """Puts bytes behind datagrams: one, two, and so on."""

    name = "extend"
    catalogue = ("H18", "D8", "D15")
    options_model = ExtendOptions
    options: ExtendOptions

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """The next length."""
        more = self.turn(datagram) % self.options.at_most + 1
        return datagram + self.chance.randbytes(more), f"{more} bytes put behind"


class SpliceOptions(ForgeryOptions):
    """Of ``splice``."""

    join: Literal["all", "body", "header", "tag", "both"] = Field(
        "all",
        description="what of the envelope before goes into this one: its body with its tag, its header, its tag, or"
        " all of it behind; all: each in its turn",
    )


class Splice(InTurn):
    """Joins parts of two envelopes: header of one with the body of another, tags swapped, two in one."""

    name = "splice"
    catalogue = ("D6", "D8")
    options_model = SpliceOptions
    options: SpliceOptions

    def __init__(self, options: SpliceOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._last: dict[Way, bytes] = {}
        self._before: bytes | None = None

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """Keep the last envelope of each way."""
        self._before = None
        if envelope_of(datagram) is not None:
            self._before = self._last.get(way)
            self._last[way] = datagram

    def is_target(self, datagram: bytes) -> bool:
        """There was another envelope before."""
        return envelope_of(datagram) is not None and self._before is not None and self._before != datagram

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """The next way to join them."""
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
                # The shortest tag: where tags are longer, their last bytes come from elsewhere all the same.
                spliced = datagram[: -wire.TAG_LENGTHS[0]] + before[-wire.TAG_LENGTHS[0] :]
            case _:
                spliced = datagram + before
        return spliced, f"{join} of envelope {other.counter} in envelope {this.counter}"


class CounterOptions(ForgeryOptions):
    """Of ``counter-jump``: the genuine envelope passes, so that a moved window would show."""

    beside: bool = Field(True, description="let the genuine datagram pass too, behind the altered one")
    to: Literal["random", "last", "ahead", "back"] = Field(
        "random", description="any counter, the last there is (2^32-2), a little ahead, or one that was used"
    )


class CounterJump(Forgery):
    """Alters the counter of envelopes: to the last one, far ahead, a little ahead, or back."""

    name = "counter-jump"
    catalogue = ("D5", "D17")
    options_model = CounterOptions
    options: CounterOptions

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with a whole header."""
        return envelope_of(datagram) is not None

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """Another counter, in the form that it is written in."""
        envelope = envelope_of(datagram)
        assert envelope is not None
        old = envelope.counter
        match self.options.to:
            case "last":
                new = c.SESSION_ENVELOPE_LIMIT - 1
            case "ahead":
                new = old + self.chance.randrange(1, 1000)
            case "back":
                new = old - self.chance.randrange(1, 100)
            case _:
                new = self.chance.randrange(c.SESSION_ENVELOPE_LIMIT)
        new %= c.SESSION_ENVELOPE_LIMIT
        if new == old:
            new = old ^ 1
        header = wire.envelope_header(envelope.receiver_index, new)
        return header + datagram[envelope.header_bytes :], f"counter {old} to {new}"


class AlterFrame(Forgery):
    """Alters the payload of envelopes, and leaves header and tag."""

    name = "alter-frame"
    catalogue = ("D6",)

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with a payload, whatever the length of their tag."""
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) > envelope.header_bytes + wire.TAG_LENGTHS[-1]

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """One byte of it."""
        envelope = envelope_of(datagram)
        assert envelope is not None
        at = self.chance.randrange(envelope.header_bytes, len(datagram) - wire.TAG_LENGTHS[-1])
        altered = bytearray(datagram)
        altered[at] ^= self.chance.randrange(1, 256)
        return bytes(altered), f"byte {at} of envelope {envelope.counter}"


class TagOptions(ForgeryOptions):
    """Of ``tamper-tag``."""

    tag: Literal["all", "zero", "random", "short", "long", "none"] = Field(
        "all", description="zeros, random bytes, cut to 8 bytes, grown to 32, or none at all; all: each in its turn"
    )


class TamperTag(InTurn):
    """Alters the tag of envelopes: zeros, random bytes, another length, none at all."""

    name = "tamper-tag"
    catalogue = ("D6", "D7")
    options_model = TagOptions
    options: TagOptions

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes with room for a tag of the usual length."""
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) >= envelope.header_bytes + 16

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """The next change of it, as if it were of the default length, 16 bytes."""
        tags = ["zero", "random", "short", "long", "none"] if self.options.tag == "all" else [self.options.tag]
        kind = tags[self.turn(datagram) % len(tags)]
        head, tag = datagram[:-16], datagram[-16:]
        match kind:
            case "zero" if any(tag):
                altered = head + bytes(16)
            case "short":
                altered = head + tag[:8]
            case "long":
                altered = datagram + self.chance.randbytes(16)
            case "none":
                altered = head
            case _:
                first = self.chance.randrange(1, 256) ^ tag[0]
                altered = head + bytes((first,)) + self.chance.randbytes(15)
        return altered, f"tag {kind}"


# Frames of the attacker's own.

_COMMANDS: tuple[tuple[str, bytes], ...] = (
    # HEARTBEAT 0: custom mode u32, type 6 (ground station), autopilot 8, base mode, status 4, version 3.
    ("HEARTBEAT", mavlink_frame(0, bytes((0, 0, 0, 0, 6, 8, 192, 4, 3)), 50)),
    # COMMAND_LONG 76: seven floats, command u16, target system and component, confirmation.
    ("disarm", mavlink_frame(76, bytes(28) + (400).to_bytes(2, "little") + bytes((1, 1, 0)), 152)),
    ("flight termination", mavlink_frame(76, b"\0\0\x80?" + bytes(24) + (185).to_bytes(2, "little") + b"\1\1", 152)),
    # SET_MODE 11: custom mode u32, target system, base mode.
    ("SET_MODE", mavlink_frame(11, bytes((6, 0, 0, 0, 1, 1)), 89)),
)
"""Name and frame: what somebody who wants the drone down would send."""


class OriginOptions(TimedOptions):
    """From where."""

    origin: Literal["sender", "stranger", "both"] = Field(
        "both", description="under a peer's address, from addresses of the attacker's own, or by turns"
    )
    sources: int = Field(16, ge=1, le=STRANGERS, description="how many addresses of its own")


class FromAnywhere(Timed[OriginOptions]):
    """Sends by itself, under a peer's address or from its own."""

    options_model: ClassVar[type[Options]] = OriginOptions

    def origin(self) -> int | None:
        """A stranger, or None for the peer's address."""
        # By turns along each way: these are taken in turn too, and there is an even number of them.
        is_turn = self.shots // len(self.ways) % 2 == 1
        is_stranger = self.options.origin == "stranger" or (self.options.origin == "both" and is_turn)
        return self.chance.randrange(self.options.sources) if is_stranger else None


class RawMavlink(FromAnywhere):
    """Sends bare MAVLink frames to the peers' ports: disarm, flight termination, mode changes, heartbeats."""

    name = "raw-mavlink"
    catalogue = ("D12",)

    def shoot(self, now: float) -> list[Action]:
        """The next frame, along the next way."""
        name, frame = _COMMANDS[self.shots // (2 * len(self.ways)) % len(_COMMANDS)]
        return self.inject(frame, self.ways[self.shots % len(self.ways)], now, name, self.origin())


class ForgeData(FromAnywhere):
    """Sends envelopes of its own making: the right session index, the next counter, a command, a random tag."""

    name = "forge-data"
    catalogue: ClassVar[tuple[str, ...]] = ("D5", "D6", "D16")

    def __init__(self, options: OriginOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._newest: dict[Way, tuple[int, int]] = {}

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """The session in use, and how far its counter is."""
        envelope = envelope_of(datagram)
        if envelope is not None:
            self._newest[way] = envelope.receiver_index, envelope.counter

    def shoot(self, now: float) -> list[Action]:
        """One envelope, along the next way on which there is a session."""
        ways = [way for way in self.ways if way in self._newest]
        if not ways:
            return []
        way = ways[self.shots % len(ways)]
        index, counter = self._newest[way]
        counter = (counter + self.chance.randrange(1, 64)) % c.SESSION_ENVELOPE_LIMIT
        name, frame = _COMMANDS[self.chance.randrange(len(_COMMANDS))]
        datagram = wire.envelope_header(index, counter) + frame + self.chance.randbytes(16)
        return self.inject(datagram, way, now, f"{name} as envelope {counter}", self.origin())


class FloodEnvelopesOptions(OriginOptions):
    """The same, faster."""

    rate_per_s: float = Field(1000.0, gt=0, le=100_000, description="datagrams a second")
    sources: int = Field(64, ge=1, le=STRANGERS, description="how many addresses of its own")


class FloodEnvelopes(ForgeData):
    """Floods with envelopes that look right and have a bad tag."""

    name = "flood-envelopes"
    catalogue = ("D16",)
    options_model = FloodEnvelopesOptions
