"""Each clause of the rule is removed: the run then finds forbidden frames that a real parser accepts."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.mavlink.parsers.judge import Admit, MakeStream, filtered
from tests.mavlink.parsers.run import run
from uavlinkd.mavlink.dialect import MESSAGES, OTHER_EXTRAS
from uavlinkd.mavlink.frames import MAVLINK2, Frame
from uavlinkd.mavlink.policy import hidden
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


def without_zero_extras(patch: pytest.MonkeyPatch) -> MakeStream:
    """Hidden frames by known definitions only."""
    patch.setattr(hidden, "_extras", without_zero)
    return filtered


def without_zero(msgid: int) -> tuple[int, ...]:
    """All but the 0 of receivers that lack the message."""
    known = MESSAGES.get(msgid)
    return (*((known[1],) if known else ()), *OTHER_EXTRAS.get(msgid, ()))


def of(stream: type[DeliveredStream]) -> Plant:
    """A filter with a method replaced."""

    def plant(patch: pytest.MonkeyPatch) -> MakeStream:
        def make(outgoing: Gate) -> Admit:
            return stream(outgoing).admit

        return make

    return plant


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


class AsksTheLast(DeliveredStream):
    """Asks only the policy of a hidden frame's last source."""

    def admit(self, frame: Frame, source: Source, now: float) -> bytes:
        """All bytes so far count as this source's."""
        self._authors = [(ends_at, source) for ends_at, _ in self._authors]
        return super().admit(frame, source, now)


PLANTS: dict[str, Plant] = {
    "MAVLink 1 starts": without_starts(lambda byte, is_1: byte == MAVLINK2),
    "MAVLink 2 starts": without_starts(lambda byte, is_1: is_1),
    "CRC_EXTRA 0": without_zero_extras,
    "frames across three": of(ShortMemory),
    "separator bytes": of(Unseparated),
    "signatures": of(TrustsSignatures),
    "policies of all sources": of(AsksTheLast),
}


@pytest.mark.parametrize("clause", PLANTS)
def test_missing_clause_is_found(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some receiver then accepts a forbidden frame."""
    result = run(MOST_STREAMS, SEED, make=PLANTS[clause](monkeypatch), share=4, stops_at=1)
    assert result.breaches_by_receiver
