"""Attacks that alter or forge datagrams: flipped bits, changed lengths, joined parts, forged counters and frames."""

from __future__ import annotations

from collections import Counter

from uavlinkd.lab.mitm.anatomy import (
    HANDSHAKE,
    DatagramKind,
    envelope_of,
    kind_of,
    matches_kind,
    mavlink_frame,
    with_changed_byte,
    with_mac1,
)
from uavlinkd.lab.mitm.attack import Action, Alteration, Direction, Timed
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire

MOST_APPENDED_BYTES = 64


class Forgery(Alteration, kinds="envelope", beside=False):
    """An alteration of datagrams of the kinds in ``kinds``. Some try all positions or lengths in turn."""

    def prepare(self) -> None:
        self._turns = Counter[DatagramKind]()

    def is_target(self, datagram: bytes) -> bool:
        return bool(datagram) and matches_kind(self.options.kinds, datagram)

    def turn(self, datagram: bytes) -> int:
        """Count 0, 1, 2 and so on, for each kind of datagram."""
        kind = kind_of(datagram)
        self._turns[kind] += 1
        return self._turns[kind] - 1


class BitFlip(Forgery, name="bit-flip", repair_mac1=False):
    """Flips one bit, at all positions in turn."""

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


class Truncate(Forgery, name="truncate"):
    """Truncates datagrams by one byte, two bytes, and so on, until they are empty."""

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        cut = self.turn(datagram) % len(datagram) + 1
        return datagram[:-cut], f"{cut} bytes cut off"


class Extend(Forgery, name="extend"):
    """Appends bytes to datagrams: one, two, and so on."""

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        more = self.turn(datagram) % MOST_APPENDED_BYTES + 1
        return datagram + self.rng.randbytes(more), f"{more} bytes appended"


class OfEnvelopes(Forgery):
    """An alteration of envelopes alone."""

    def is_target(self, datagram: bytes) -> bool:
        return envelope_of(datagram) is not None


class Splice(OfEnvelopes, name="splice"):
    """Joins parts of two envelopes: header and body of different ones, swapped tags, two in one datagram."""

    def prepare(self) -> None:
        super().prepare()
        self._last: dict[Direction, bytes] = {}
        self._before = b""

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        self._before = b""
        if envelope_of(datagram) is not None:
            self._before, self._last[direction] = self._last.get(direction, b""), datagram

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes that follow a different envelope."""
        return super().is_target(datagram) and self._before not in (b"", datagram)

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        before, this, other = self._before, envelope_of(datagram), envelope_of(self._before)
        assert this is not None
        assert other is not None
        shortest = wire.TAG_LENGTHS[0]  # of a longer tag, this replaces the last bytes
        spliced = {
            "body": datagram[: this.header_bytes] + before[other.header_bytes :],
            "header": before[: other.header_bytes] + datagram[this.header_bytes :],
            "tag": datagram[:-shortest] + before[-shortest:],
            "both": datagram + before,
        }
        join = list(spliced)[self.turn(datagram) % len(spliced)]
        return spliced[join], f"{join} of envelope {other.counter} in envelope {this.counter}"


class CounterJump(OfEnvelopes, name="counter-jump", beside=True, to="random"):
    """Alters the counter of envelopes: to the last valid one, far ahead, a little ahead, or back.

    The genuine envelope passes too: a moved replay window would show.
    """

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
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


class AlterFrame(Forgery, name="alter-frame"):
    """Alters the payload of envelopes, but not the header and the tag, whatever its length."""

    def is_target(self, datagram: bytes) -> bool:
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) > envelope.header_bytes + wire.TAG_LENGTHS[-1]

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        envelope = envelope_of(datagram)
        assert envelope is not None
        at = self.rng.randrange(envelope.header_bytes, len(datagram) - wire.TAG_LENGTHS[-1])
        return with_changed_byte(datagram, at, self.rng), f"byte {at} of envelope {envelope.counter}"


class TamperTag(Forgery, name="tamper-tag"):
    """Alters the tag of envelopes: zeros, random bytes, another length, or no tag."""

    def is_target(self, datagram: bytes) -> bool:
        envelope = envelope_of(datagram)
        return envelope is not None and len(datagram) >= envelope.header_bytes + 16

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The next change, for a tag of the default length of 16 bytes."""
        kind = ("zero", "random", "short", "long", "none")[self.turn(datagram) % 5]
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
                altered = head + with_changed_byte(tag, 0, self.rng)[:1] + self.rng.randbytes(15)
        return altered, f"tag {kind}"


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


class FromAnywhere(Timed, origin="both", sources=16):
    """An attack that injects datagrams from a peer's address or from strangers."""

    def stranger(self) -> int | None:
        """The source: a stranger, or None for the peer's address."""
        # Alternate per direction, because directions alternate too and their number is even.
        is_turn = self.sent_count // len(self.directions) % 2 == 1
        is_stranger = self.options.origin == "stranger" or (self.options.origin == "both" and is_turn)
        return self.rng.randrange(max(1, self.options.sources)) if is_stranger else None


class ForgeData(FromAnywhere, name="forge-data"):
    """Injects forged envelopes: valid session index, a coming counter, a command, a random tag."""

    def prepare(self) -> None:
        super().prepare()
        self._newest: dict[Direction, tuple[int, int]] = {}

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        envelope = envelope_of(datagram)
        if envelope is not None:
            self._newest[direction] = envelope.receiver_index, envelope.counter

    def send_next(self, now: float) -> list[Action]:
        directions = [direction for direction in self.directions if direction in self._newest]
        if not directions:
            return []
        direction = directions[self.sent_count % len(directions)]
        index, counter = self._newest[direction]
        counter = (counter + self.rng.randrange(1, 64)) % c.SESSION_ENVELOPE_LIMIT
        name, frame = COMMAND_FRAMES[self.rng.randrange(len(COMMAND_FRAMES))]
        datagram = wire.envelope_header(index, counter) + frame + self.rng.randbytes(16)
        return self.inject(datagram, direction, now, f"{name} as envelope {counter}", self.stranger())


class FloodEnvelopes(ForgeData, name="flood-envelopes", rate_per_s=1000.0, sources=64):
    """Floods with envelopes that are valid except for the tag."""


class RawMavlink(FromAnywhere, name="raw-mavlink"):
    """Sends bare MAVLink frames to the peers' ports: disarm, flight termination, mode changes, heartbeats."""

    def send_next(self, now: float) -> list[Action]:
        name, frame = COMMAND_FRAMES[self.sent_count // (2 * len(self.directions)) % len(COMMAND_FRAMES)]
        return self.inject(frame, self.directions[self.sent_count % len(self.directions)], now, name, self.stranger())
