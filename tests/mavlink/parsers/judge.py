"""The judge: whether policy passes the frames that a receiver accepts, independent of the daemon's filter.

It knows the policies and the sender of each byte, and nothing of hidden frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

from tests.mavlink.parsers.captured_member import CAST
from tests.mavlink.parsers.generate import CLIENTS, LETS_UNKNOWN_PASS, Recipe
from tests.mavlink.parsers.hidden_frames import SIGNATURE_BYTES, crc_extra, msgid_of
from tests.mavlink.parsers.receivers import Accepted, Batch, Delivery, Receiver
from uavlinkd.mavlink.dialect import OTHER_EXTRAS
from uavlinkd.mavlink.frames import MAVLINK2, Frame, SplitCounters, parse_frame, split_payload
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source
from uavlinkd.mavlink.policy.gate import Gate

_LONG_S = 1e6  # between two frames: rates are not looked at


class Stream(NamedTuple):
    """The bytes that one client read, and the source of each."""

    delivery: Delivery
    authors: Sequence[tuple[int, str | None]]  # up to which offset whose; None: separator bytes
    client: int


Admit = Callable[[Frame, Source, float], bytes]
"""``DeliveredStream.admit``."""
MakeStream = Callable[[Gate], Admit]


def filtered(outgoing: Gate) -> Admit:
    """The daemon's own filter."""
    return DeliveredStream(outgoing).admit


def unfiltered(outgoing: Gate) -> Admit:
    """Policy without the filter."""
    return lambda frame, source, now: frame.raw


@dataclass
class Deliverer:
    """Passes recipes through policy and filter."""

    make: MakeStream = filtered
    cast: Mapping[str, Mapping[str, object]] = field(default_factory=lambda: CAST)
    refused: int = 0
    admitted: int = 0
    _now: float = 0.0

    def __post_init__(self) -> None:
        self._gates = {name: Policy(data).incoming for name, data in self.cast.items()}
        self._outgoing = [Policy(data, is_local=True).outgoing for data in CLIENTS]

    def deliver(self, recipe: Recipe) -> Stream:
        """The stream that the client reads."""
        outgoing = self._outgoing[recipe.client]
        admit = self.make(outgoing)
        sources = {part.sender: Source(part.sender, self._gates[part.sender]) for part in recipe.parts}
        stream = bytearray()
        authors: list[tuple[int, str | None]] = []
        frames = []
        for part in recipe.parts:
            frame = parse_frame(part.raw)
            self._now += _LONG_S
            if frame is None or self._gates[part.sender].check(frame, self._now) is not None:
                continue
            if outgoing.check(frame, self._now) is not None:
                continue
            data = admit(frame, sources[part.sender], self._now)
            if not data:
                self.refused += 1
                continue
            assert data.endswith(part.raw), "a frame is delivered whole, or not at all"
            self.admitted += 1
            begin = len(stream) + len(data) - len(part.raw)
            if begin > len(stream):
                authors.append((begin, None))
            stream += data
            authors.append((len(stream), part.sender))
            frames.append((begin, len(stream)))
        return Stream(Delivery(bytes(stream), frames), authors, recipe.client)


class Breach(NamedTuple):
    """A forbidden frame that a receiver accepted."""

    receiver: str
    raw: bytes
    senders: tuple[str, ...]
    accepted: Accepted
    stream: bytes


@dataclass
class Verdicts:
    """The verdicts on the frames that receivers accepted in addition to the delivered ones."""

    counts: Counter[str] = field(default_factory=Counter)
    """``harmless``; ``spanning`` a loss, and ``spanning_forbidden`` of these; ``private``: forbidden frames by a
    private definition, from sources without unknown messages in their lists, a limit; ``truncated``: not judged,
    because there were too many."""
    breaches: list[Breach] = field(default_factory=list)


def is_private(raw: bytes) -> bool:
    """Whether a frame's checksum fits no CRC_EXTRA of a public definition, and not the 0 of receivers without one."""
    msgid = msgid_of(raw)
    extras = {0, crc_extra(msgid), *OTHER_EXTRAS.get(msgid, ())}
    end = _checked_bytes(raw)
    fitting = {mcrf4xx(raw[1 : end - 2] + bytes((extra,))).to_bytes(2, "little") for extra in extras}
    return raw[end - 2 : end] not in fitting


def _checked_bytes(raw: bytes) -> int:
    """Bytes of a frame up to the end of its checksum.

    The sender of these bytes made the frame. The signature may be another sender's bytes: without a key a receiver
    ignores them, and with a key no sender can choose them.
    """
    return len(raw) - (SIGNATURE_BYTES if raw[0] == MAVLINK2 and raw[2] else 0)


class Judge:
    """Has policies of its own, compiled from the same data."""

    def __init__(
        self, cast: Mapping[str, Mapping[str, object]] = CAST, clients: Sequence[Mapping[str, object]] = CLIENTS
    ) -> None:
        self._gates = {name: Policy(data).incoming for name, data in cast.items()}
        self._outgoing = [Policy(data, is_local=True).outgoing for data in clients]
        self._now = 0.0

    def is_forbidden(self, raw: bytes, senders: Iterable[str], client: int = 0) -> bool:
        """Whether policy refuses this frame from any sender of its bytes, or refuses it to the client."""
        counters = SplitCounters()
        frames = split_payload(raw, counters)
        if len(frames) != 1:
            return True
        self._now += _LONG_S
        frame = frames[0]
        refusals = [self._gates[sender].check(frame, self._now) for sender in senders]
        refusals.append(self._outgoing[client].check(frame, self._now))
        return any(refusal is not None for refusal in refusals)

    def examine(
        self, receiver: Receiver, streams: Sequence[Stream], accepted_frames: Sequence[Accepted], into: Verdicts
    ) -> None:
        """Sort the frames that a receiver accepted into verdicts."""
        for accepted in accepted_frames:
            stream = streams[accepted.stream]
            end = accepted.start + _checked_bytes(accepted.raw) + (accepted.lost if accepted.spans else 0)
            senders = _authors(stream.authors, accepted.start, end)
            is_forbidden = self.is_forbidden(accepted.raw, senders, stream.client)
            if accepted.spans:
                into.counts.update(spanning=1, spanning_forbidden=int(is_forbidden))
            elif is_forbidden and is_private(accepted.raw) and not LETS_UNKNOWN_PASS.intersection(senders):
                into.counts["private"] += 1
            elif is_forbidden:
                into.breaches.append(Breach(receiver.name, accepted.raw, senders, accepted, stream.delivery.stream))
            else:
                into.counts["harmless"] += 1


def _authors(authors: Sequence[tuple[int, str | None]], start: int, end: int) -> tuple[str, ...]:
    senders = []
    begin = 0
    for until, sender in authors:
        if sender is not None and begin < end and start < until:
            senders.append(sender)
        begin = until
    return tuple(dict.fromkeys(senders))


def judge_all(
    streams: Sequence[Stream],
    receivers: Iterable[Receiver],
    judge: Judge,
    *,
    every_offset: bool = True,
    losses: int = 1,
    seed: int = 1,
) -> Verdicts:
    """Pass the streams to every receiver, from every offset and after losses."""
    verdicts = Verdicts()
    batch = Batch([stream.delivery for stream in streams])
    for receiver in receivers:
        total, accepted = receiver.judge(batch, every_offset=every_offset, losses=losses, seed=seed)
        verdicts.counts["truncated"] += total - len(accepted)
        judge.examine(receiver, streams, accepted, verdicts)
    return verdicts
