"""The proof by real parsers: generated streams, through policy and filter, to receivers of the C library.

``python -m tests.mavlink.parsers.run`` prints counts, the steps of the parsers that no stream covered, and each
forbidden frame that a receiver accepted. Exit status 0 if there was not one and every step was covered.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from tests.mavlink.parsers.generate import Generator
from tests.mavlink.parsers.judge import Deliverer, Judge, MakeStream, Verdicts, filtered, judge_all
from tests.mavlink.parsers.receivers import EVERY_LOSS, Receiver, all_receivers

BATCH = 250
EXHAUSTIVE_EVERY = 40
"""One batch of so many has a stream that is read after every loss."""
MOST_BREACHES = 50


def _steps(table: str) -> frozenset[tuple[str, str]]:
    rows = (line.split() for line in table.strip().splitlines())
    return frozenset((before, after) for before, *afters in rows for after in afters)


# The parser's states, and what can follow each. A GOT_STX behind a checksum or a signature: its last byte is a start.
_STEPS_2 = _steps("""
    UNINIT UNINIT GOT_STX
    IDLE IDLE GOT_STX
    GOT_STX GOT_LENGTH GOT_COMPAT_FLAGS
    GOT_LENGTH GOT_INCOMPAT_FLAGS IDLE
    GOT_INCOMPAT_FLAGS GOT_COMPAT_FLAGS
    GOT_COMPAT_FLAGS GOT_SEQ
    GOT_SEQ GOT_SYSID
    GOT_SYSID GOT_COMPID
    GOT_COMPID GOT_MSGID1 GOT_MSGID3 GOT_PAYLOAD
    GOT_MSGID1 GOT_MSGID2
    GOT_MSGID2 GOT_MSGID3 GOT_PAYLOAD
    GOT_MSGID3 GOT_MSGID3 GOT_PAYLOAD
    GOT_PAYLOAD GOT_CRC1 GOT_BAD_CRC1
    GOT_CRC1 IDLE SIGNATURE_WAIT GOT_STX
    GOT_BAD_CRC1 IDLE GOT_STX SIGNATURE_WAIT_BAD_CRC
    SIGNATURE_WAIT SIGNATURE_WAIT IDLE GOT_STX
    SIGNATURE_WAIT_BAD_CRC SIGNATURE_WAIT_BAD_CRC IDLE
""")
_STEPS_1 = _steps("""
    UNINIT UNINIT GOT_STX
    IDLE IDLE GOT_STX
    GOT_STX GOT_LENGTH
    GOT_LENGTH GOT_SEQ
    GOT_SEQ GOT_SYSID
    GOT_SYSID GOT_COMPID
    GOT_COMPID GOT_MSGID GOT_PAYLOAD
    GOT_MSGID GOT_MSGID GOT_PAYLOAD
    GOT_PAYLOAD GOT_CRC1 GOT_BAD_CRC1
    GOT_CRC1 IDLE
    GOT_BAD_CRC1 IDLE GOT_STX
""")


@dataclass
class Result:
    """The result of a run."""

    counts: Counter[str] = field(default_factory=Counter)
    verdicts: Verdicts = field(default_factory=Verdicts)
    breaches_by_receiver: Counter[str] = field(default_factory=Counter)
    steps: dict[str, set[tuple[str, str]]] = field(default_factory=lambda: {"1.0": set(), "2.0": set()})

    @property
    def missing_steps(self) -> set[tuple[str, str]]:
        """Steps of either library's parser that no stream covered."""
        return set(_STEPS_1 - self.steps["1.0"]) | set(_STEPS_2 - self.steps["2.0"])

    def add(self, other: Result) -> None:
        """Add the result of another run."""
        self.counts += other.counts
        ours, theirs = self.verdicts, other.verdicts
        ours.counts += theirs.counts
        ours.breaches = (ours.breaches + theirs.breaches)[:MOST_BREACHES]
        self.breaches_by_receiver += other.breaches_by_receiver
        for library, steps in other.steps.items():
            self.steps[library] |= steps

    def lines(self) -> list[str]:
        """The result as text."""
        lines = [f"{count:,} {name}" for name, count in (self.counts + self.verdicts.counts).items()]
        lines += [f"parser step missing: {before} to {after}" for before, after in sorted(self.missing_steps)]
        lines += [
            f"{count:,} forbidden frames accepted by {name}" for name, count in self.breaches_by_receiver.items()
        ]
        lines += [
            f"  {breach.receiver}: {breach.raw.hex(' ')} of {', '.join(breach.senders)} at {breach.accepted.start} "
            f"of {breach.stream.hex()}"
            for breach in self.verdicts.breaches[:5]
        ]
        return lines


def run(
    streams: int,
    seed: int,
    *,
    make: MakeStream = filtered,
    receivers: Sequence[Receiver] | None = None,
    share: int = 1,
) -> Result:
    """Run so many streams.

    ``share``: one in so many receivers reads a batch, in turn.
    """
    receivers = all_receivers() if receivers is None else receivers
    generator, deliverer, judge = Generator(seed), Deliverer(make), Judge()
    result = Result()
    number = 0
    while result.counts["streams"] < streams:
        size = min(BATCH, streams - result.counts["streams"])
        batch = [deliverer.deliver(generator.recipe()) for _ in range(size)]
        chosen = receivers[number % share :: share]
        rounds = [judge_all(batch, chosen, judge, seed=seed * 1_000_003 + number)]
        if number % EXHAUSTIVE_EVERY == EXHAUSTIVE_EVERY - 1:
            rounds.append(judge_all(batch[:1], chosen, judge, every_offset=False, losses=EVERY_LOSS))
        for verdicts in rounds:
            result.add(Result(verdicts=verdicts, breaches_by_receiver=Counter(b.receiver for b in verdicts.breaches)))
        result.counts["streams"] += size
        result.counts["separators"] += sum(author is None for stream in batch for _, author in stream.authors)
        number += 1
    result.counts.update(frames=deliverer.admitted, refused=deliverer.refused)
    for receiver in receivers:
        result.counts.update(parses=receiver.counts.parses, losses=receiver.counts.losses)
        result.steps[receiver.library[:3]] |= set(receiver.steps)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: no forbidden frame was accepted. 1: one was, or steps are missing. 2: invalid command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.parsers.run", description=__doc__)
    parser.add_argument("--streams", type=int, default=10_000, help="how many streams to try (10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the generated streams")
    options = parser.parse_args(arguments)
    result = run(options.streams, options.seed, share=4)
    print("\n".join(result.lines()))
    return int(bool(result.breaches_by_receiver or result.verdicts.counts["truncated"] or result.missing_steps))


if __name__ == "__main__":
    sys.exit(main())
