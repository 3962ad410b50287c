"""A run of the property: generated streams, through policy and filter, to every receiver."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import monotonic

from tests.mavlink.parsers.generate import Generator
from tests.mavlink.parsers.judge import Deliverer, Judge, MakeStream, Verdicts, filtered, judge_all
from tests.mavlink.parsers.receivers import EVERY_LOSS, STATES_2, Receiver, all_receivers

BATCH = 250
EXHAUSTIVE_EVERY = 40
"""One batch of so many has a stream that is read after every loss."""
MOST_BREACHES = 50

_UNSIGNED_STEPS = [(STATES_2[k], STATES_2[k + 1]) for k in range(1, 12)]
_STEPS_2 = frozenset(
    {
        *_UNSIGNED_STEPS,
        ("UNINIT", "UNINIT"),  # noise before the first start byte
        ("UNINIT", "GOT_STX"),
        ("IDLE", "IDLE"),
        ("GOT_STX", "GOT_COMPAT_FLAGS"),  # MAVLink 1
        ("GOT_LENGTH", "IDLE"),  # unknown incompat_flags
        ("GOT_COMPID", "GOT_MSGID3"),  # MAVLink 1
        ("GOT_COMPID", "GOT_PAYLOAD"),  # MAVLink 1, no payload
        ("GOT_MSGID2", "GOT_PAYLOAD"),  # no payload
        ("GOT_MSGID3", "GOT_MSGID3"),
        ("GOT_MSGID3", "GOT_PAYLOAD"),
        ("GOT_PAYLOAD", "GOT_CRC1"),
        ("GOT_PAYLOAD", "GOT_BAD_CRC1"),
        ("GOT_CRC1", "IDLE"),
        ("GOT_CRC1", "SIGNATURE_WAIT"),
        ("GOT_BAD_CRC1", "IDLE"),
        ("GOT_BAD_CRC1", "GOT_STX"),  # the last byte of a rejected checksum is a start byte
        ("GOT_CRC1", "GOT_STX"),  # the same, its first byte fitted or an unsigned frame was rejected
        ("GOT_BAD_CRC1", "SIGNATURE_WAIT_BAD_CRC"),  # mavlink_frame_char_buffer alone waits for the signature
        ("SIGNATURE_WAIT", "SIGNATURE_WAIT"),
        ("SIGNATURE_WAIT", "IDLE"),
        ("SIGNATURE_WAIT", "GOT_STX"),  # the last byte of a rejected signature is a start byte
        ("SIGNATURE_WAIT_BAD_CRC", "SIGNATURE_WAIT_BAD_CRC"),
        ("SIGNATURE_WAIT_BAD_CRC", "IDLE"),
    }
)
_STEPS_1 = frozenset(
    {
        ("UNINIT", "UNINIT"),
        ("UNINIT", "GOT_STX"),
        ("IDLE", "IDLE"),
        ("IDLE", "GOT_STX"),
        ("GOT_STX", "GOT_LENGTH"),
        ("GOT_LENGTH", "GOT_SEQ"),
        ("GOT_SEQ", "GOT_SYSID"),
        ("GOT_SYSID", "GOT_COMPID"),
        ("GOT_COMPID", "GOT_MSGID"),
        ("GOT_COMPID", "GOT_PAYLOAD"),
        ("GOT_MSGID", "GOT_MSGID"),
        ("GOT_MSGID", "GOT_PAYLOAD"),
        ("GOT_PAYLOAD", "GOT_CRC1"),
        ("GOT_PAYLOAD", "GOT_BAD_CRC1"),
        ("GOT_CRC1", "IDLE"),
        ("GOT_BAD_CRC1", "IDLE"),
        ("GOT_BAD_CRC1", "GOT_STX"),
    }
)


@dataclass
class Result:
    """The result of a run."""

    streams: int = 0
    stream_bytes: int = 0
    admitted: int = 0
    refused: int = 0
    separators: int = 0
    parses: int = 0
    losses: int = 0
    accepted: int = 0
    verdicts: Verdicts = field(default_factory=Verdicts)
    breaches_by_receiver: Counter[str] = field(default_factory=Counter)
    steps: dict[str, set[tuple[str, str]]] = field(default_factory=lambda: {"1.0": set(), "2.0": set()})
    seconds: float = 0.0

    @property
    def missing_steps(self) -> dict[str, set[tuple[str, str]]]:
        """Steps of each library's parser that no stream covered."""
        return {"1.0": set(_STEPS_1 - self.steps["1.0"]), "2.0": set(_STEPS_2 - self.steps["2.0"])}

    def add(self, other: Result) -> None:
        """Add the result of another run."""
        for name in ("streams", "stream_bytes", "admitted", "refused", "separators", "parses", "losses", "accepted"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        ours, theirs = self.verdicts, other.verdicts
        for name in ("harmless", "spanning", "spanning_forbidden", "private", "truncated"):
            setattr(ours, name, getattr(ours, name) + getattr(theirs, name))
        ours.breaches = (ours.breaches + theirs.breaches)[:MOST_BREACHES]
        self.breaches_by_receiver += other.breaches_by_receiver
        for library, steps in other.steps.items():
            self.steps[library] |= steps
        self.seconds = max(self.seconds, other.seconds)

    def lines(self) -> list[str]:
        """The result as text."""
        verdicts = self.verdicts
        covered = sum(map(len, self.steps.values()))
        missing = [f"{a} to {b}" for steps in self.missing_steps.values() for a, b in sorted(steps)]
        lines = [
            f"{self.streams:,} streams of {self.admitted:,} frames, {self.stream_bytes:,} bytes; "
            f"{self.refused:,} frames refused, separator bytes before {self.separators:,}",
            f"{self.parses:,} parses by real parsers, {self.losses:,} of them with a loss of 1 to 300 bytes",
            f"{self.accepted:,} frames accepted; beyond the delivered ones {verdicts.harmless:,} that policy passes",
            f"{verdicts.spanning:,} frames accepted that span the loss, {verdicts.spanning_forbidden:,} of them "
            f"forbidden: one in {self.losses / max(1, verdicts.spanning_forbidden):,.0f} losses",
            f"{verdicts.private:,} forbidden frames by private definitions that the daemon cannot know",
            f"parser steps covered: {covered}; missing: {', '.join(missing) or 'none'}",
            f"forbidden frames accepted: {sum(self.breaches_by_receiver.values()):,}",
        ]
        lines += [f"  {count:,} by {name}" for name, count in self.breaches_by_receiver.most_common(10)]
        lines += [
            f"  {breach.receiver}: {breach.raw.hex(' ')} of {', '.join(breach.senders)} at {breach.accepted.start} "
            f"of {breach.stream.hex()}"
            for breach in verdicts.breaches[:5]
        ]
        return lines


def run(
    streams: int,
    seed: int,
    *,
    make: MakeStream = filtered,
    receivers: Sequence[Receiver] | None = None,
    share: int = 1,
    stops_at: int | None = None,
    progress: Callable[[Result], None] = lambda result: None,
) -> Result:
    """Run so many streams.

    ``share``: one in so many receivers reads a batch, in turn. ``stops_at``: stop after so many forbidden frames.
    """
    receivers = all_receivers() if receivers is None else receivers
    generator, deliverer, judge = Generator(seed), Deliverer(make), Judge()
    result = Result()
    began = monotonic()
    number = 0
    while result.streams < streams:
        batch = [deliverer.deliver(generator.recipe()) for _ in range(min(BATCH, streams - result.streams))]
        chosen = receivers[number % share :: share]
        verdicts = judge_all(batch, chosen, judge, seed=seed * 1_000_003 + number)
        one = Result(verdicts=verdicts)
        if number % EXHAUSTIVE_EVERY == EXHAUSTIVE_EVERY - 1:
            every = judge_all(batch[:1], chosen, judge, every_offset=False, losses=EVERY_LOSS)
            one.breaches_by_receiver.update(breach.receiver for breach in every.breaches)
            one.add(Result(verdicts=every))
        one.breaches_by_receiver.update(breach.receiver for breach in verdicts.breaches)
        one.streams = len(batch)
        one.stream_bytes = sum(len(stream.delivery.stream) for stream in batch)
        one.separators = sum(author is None for stream in batch for _, author in stream.authors)
        result.add(one)
        result.seconds = monotonic() - began
        number += 1
        progress(result)
        if stops_at is not None and sum(result.breaches_by_receiver.values()) >= stops_at:
            break
    result.admitted, result.refused = deliverer.admitted, deliverer.refused
    for receiver in receivers:
        counts = receiver.counts
        result.parses += counts.parses
        result.losses += counts.losses
        result.accepted += counts.accepted
        result.steps[receiver.library[:3]] |= set(receiver.steps)
    return result
