"""Each clause of the rule is removed: the run then finds forbidden frames that a real parser accepts."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.mavlink.parsers.generate import EVERYTHING
from tests.mavlink.parsers.judge import Admit, MakeStream, filtered
from tests.mavlink.parsers.run import Result, run
from uavlinkd.mavlink.dialect_table import MESSAGES, OTHER_EXTRAS
from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2, Frame
from uavlinkd.mavlink.policy import hidden
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source
from uavlinkd.mavlink.policy.gate import Gate

pytestmark = pytest.mark.long

MOST_STREAMS = 60_000
SEED = 15
Plant = Callable[[pytest.MonkeyPatch], MakeStream]


def without_starts(is_kept: Callable[[int, bool], bool]) -> Plant:
    """Hidden frames of some start bytes and versions only."""

    def plant(patch: pytest.MonkeyPatch) -> MakeStream:
        real = hidden.starts_in

        def some(data: bytes, begin: int) -> list[hidden.Start]:
            return [(at, is_1) for at, is_1 in real(data, begin) if is_kept(data[at], is_1)]

        patch.setattr(hidden, "starts_in", some)
        return filtered

    return plant


def without_restarts(patch: pytest.MonkeyPatch) -> MakeStream:
    """As if no parser continued in MAVLink 1 at the last byte of a rejected frame."""
    patch.setattr(hidden, "restart", lambda data, start, end: None)
    return filtered


def without_extras(kept: Callable[[int], tuple[int, ...]]) -> Plant:
    """Hidden frames of some CRC_EXTRA only."""

    def plant(patch: pytest.MonkeyPatch) -> MakeStream:
        patch.setattr(hidden, "_extras", kept)
        return filtered

    return plant


def by_definition(msgid: int) -> tuple[int, ...]:
    """The table's CRC_EXTRA alone."""
    return (MESSAGES[msgid][1],) if msgid in MESSAGES else ()


def without_zero(msgid: int) -> tuple[int, ...]:
    """All but the 0 of receivers that lack the message."""
    known = MESSAGES.get(msgid)
    return (*((known[1],) if known else ()), *OTHER_EXTRAS.get(msgid, ()))


def without_alternatives(msgid: int) -> tuple[int, ...]:
    """All but those of other definitions."""
    return (0, *by_definition(msgid))


def of(stream: type[DeliveredStream]) -> Plant:
    """A filter with a method replaced."""

    def plant(patch: pytest.MonkeyPatch) -> MakeStream:
        def make(outgoing: Gate) -> Admit:
            return stream(outgoing).admit

        return make

    return plant


class Forgetful(DeliveredStream):
    """Looks for hidden frames within a frame, and not across two."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """Start again with each frame."""
        self.__init__(self.outgoing)  # type: ignore[misc]
        return super().admit(frame, source, now)


class ShortMemory(DeliveredStream):
    """Looks for hidden frames across two frames, and not across three."""

    _previous: tuple[Frame, Source] | None = None

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """Start again with the frame before this one."""
        two = DeliveredStream(self.outgoing)
        if self._previous is not None:
            two.admit(*self._previous, now)
        self._previous = frame, source
        return two.admit(frame, source, now)


class Unseparated(DeliveredStream):
    """Delivers frames of different sources without separator bytes."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """Refuse as always, but leave out the bytes before the frame."""
        return super().admit(frame, source, now)[-len(frame.raw) :]


class TrustsSignatures(DeliveredStream):
    """Does not search signatures."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """Search a signature of zeros instead of the frame's own."""
        raw = frame.raw
        if raw[0] != MAVLINK2 or not raw[2]:
            return super().admit(frame, source, now)
        data = super().admit(Frame(raw[:-13] + bytes(13), frame.header), source, now)
        return data[: -len(raw)] + raw if data else b""


class TrustsChecksums(DeliveredStream):
    """Does not accept a checksum's bytes as start bytes."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """Search a frame without a start byte in its checksum."""
        raw = bytearray(frame.raw)
        end = len(raw) - (13 if raw[0] == MAVLINK2 and raw[2] else 0)
        raw[end - 2 : end] = bytes(0 if byte in (MAVLINK1, MAVLINK2) else byte for byte in raw[end - 2 : end])
        data = super().admit(Frame(bytes(raw), frame.header), source, now)
        return data[: -len(raw)] + frame.raw if data else b""


class AsksTheLast(DeliveredStream):
    """Asks only the policy of a hidden frame's last source."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """All bytes so far count as this source's."""
        self._authors = [(ends_at, source) for ends_at, _ in self._authors]
        return super().admit(frame, source, now)


class AsksNobodyForTheClient(DeliveredStream):
    """Does not check the client's policy."""

    def __init__(self, outgoing: Gate | None = None) -> None:
        super().__init__(None)


class AsksNoSource(DeliveredStream):
    """Does not check the source's policy."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """As if its source might send everything."""
        return super().admit(frame, Source(source.name, _EVERYTHING), now)


_EVERYTHING = compile_policy(EVERYTHING).incoming


def without_any_extra(patch: pytest.MonkeyPatch) -> MakeStream:
    """CRC_EXTRA by definition also where policy passes unknown messages."""
    patch.setattr(Gate, "passes_unknown", False)
    return filtered


PLANTS: dict[str, Plant] = {
    "MAVLink 1 starts": without_starts(lambda byte, is_1: byte == MAVLINK2),
    "MAVLink 2 starts": without_starts(lambda byte, is_1: is_1),
    "MAVLink 1 from 0xFD on": without_restarts,
    "CRC_EXTRA 0": without_extras(without_zero),
    "CRC_EXTRA of other definitions": without_extras(without_alternatives),
    "any CRC_EXTRA where unknown messages pass": without_any_extra,
    "frames across two": of(Forgetful),
    "frames across three": of(ShortMemory),
    "separator bytes": of(Unseparated),
    "signatures": of(TrustsSignatures),
    "checksums": of(TrustsChecksums),
    "policies of all sources": of(AsksTheLast),
    "policy of the source": of(AsksNoSource),
    "policy of the client": of(AsksNobodyForTheClient),
}


def found(make: MakeStream) -> Result:
    """The result, up to the first forbidden frame."""
    return run(MOST_STREAMS, SEED, make=make, share=4, stops_at=1)


@pytest.mark.parametrize("clause", PLANTS)
def test_missing_clause_is_found(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some receiver then accepts a forbidden frame."""
    result = found(PLANTS[clause](monkeypatch))
    assert result.breaches_by_receiver
