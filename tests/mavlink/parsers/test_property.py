"""For any delivered stream: policy passes each frame that a real parser accepts, from the senders of its bytes."""

from __future__ import annotations

import pytest

from tests.mavlink.parsers.generate import Generator
from tests.mavlink.parsers.judge import Deliverer, unfiltered
from tests.mavlink.parsers.receivers import Batch, Delivery, Options, Receiver
from tests.mavlink.parsers.run import run

STREAMS = 6000


@pytest.mark.long
def test_no_receiver_accepts_what_policy_forbids() -> None:
    """From any offset and after a random loss; the streams cover every step of the parsers."""
    result = run(STREAMS, seed=15, share=4)
    assert not result.breaches_by_receiver, "\n".join(result.lines())
    assert not result.missing_steps
    assert result.verdicts.counts["truncated"] == 0
    assert result.counts["refused"] > STREAMS // 100
    assert result.counts["separators"] > STREAMS // 100
    assert result.verdicts.counts["harmless"] > 0


@pytest.mark.long
def test_streams_are_dangerous() -> None:
    """Without the filter the same streams make receivers accept forbidden frames."""
    result = run(500, seed=15, make=unfiltered, share=4)
    assert sum(result.breaches_by_receiver.values()) > 100


def test_one_attempt_at_each_start_byte_is_enough() -> None:
    """The result is the same as that of reading the stream's rest from every offset."""
    generator, deliverer = Generator(4), Deliverer(unfiltered)
    receiver = Receiver("common", "2.0", Options(resumes=False))
    for _ in range(60):
        delivery = deliverer.deliver(generator.recipe()).delivery
        _, short = receiver.judge(Batch([delivery]), every_offset=True)
        plain: set[tuple[int, bytes]] = set()
        for offset in range(len(delivery.stream)):
            later = [(a - offset, b - offset) for a, b in delivery.frames if a >= offset]
            _, accepted = receiver.judge(Batch([Delivery(delivery.stream[offset:], later)]))
            plain |= {(frame.start + offset, frame.raw) for frame in accepted}
        assert {(frame.start, frame.raw) for frame in short} == plain


def test_same_seed_makes_the_same_streams() -> None:
    """A run can be repeated."""
    first, second = Generator(9), Generator(9)
    assert [first.recipe() for _ in range(50)] == [second.recipe() for _ in range(50)]
