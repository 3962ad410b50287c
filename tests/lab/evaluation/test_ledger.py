"""The ledger detects every false frame and its kind."""

from __future__ import annotations

import pytest

from uavlinkd.lab.evaluation.ledger import STALE_S, Fault, Ledger, numbered_frame


def delivered(ledger: Ledger) -> int:
    """The number of correctly delivered frames."""
    return sum(len(flags) - flags.count(0) for flags in ledger._delivered.values())


@pytest.fixture
def ledger() -> Ledger:
    """Two drones; one frame of each has been sent."""
    ledger = Ledger(("a", "b"))
    ledger.next_frame("a", 1.0)
    ledger.next_frame("b", 1.0)
    return ledger


def test_what_comes_long_after_it_was_sent_is_stale(ledger: Ledger) -> None:
    """Unaltered, but late: an attacker held it."""
    ledger.on_received("b", numbered_frame(1, 0), 1.0 + STALE_S)
    assert not ledger.faults
    ledger.on_received("a", numbered_frame(2, 0), 1.1 + STALE_S)
    assert ledger.faults == {Fault.STALE: 1}


@pytest.mark.parametrize(
    ("receiver", "frame", "fault"),
    [
        ("b", numbered_frame(1, 1), Fault.FALSE),  # never sent
        ("b", numbered_frame(7, 0), Fault.FALSE),  # an unknown sender
        ("b", numbered_frame(1, 0)[:-3] + b"\x00\x00\x00", Fault.FALSE),
        ("b", b"\xfd", Fault.FALSE),
        ("b", b"", None),
        ("b", b"\x02\x02", Fault.FALSE),
        ("a", numbered_frame(1, 0), Fault.REFLECTED),
    ],
)
def test_what_may_not_come_out_is_a_fault(ledger: Ledger, receiver: str, frame: bytes, fault: Fault | None) -> None:
    """Forged, altered, cut short, or one's own."""
    ledger.on_received(receiver, frame, 1.5)
    assert set(ledger.faults) == ({fault} if fault else set())
    assert delivered(ledger) == 0


@pytest.mark.parametrize(
    ("before", "is_fault"), [(b"\x02" * 7, False), (b"\x02" * 280, False), (b"\x02" * 281, True), (b"\x02\xfe", True)]
)
def test_separator_bytes_may_precede_a_frame(ledger: Ledger, before: bytes, *, is_fault: bool) -> None:
    """Neither too many, nor with a start byte."""
    ledger.on_received("b", before + numbered_frame(1, 0), 1.5)
    assert dict(ledger.faults) == ({Fault.FALSE: 1} if is_fault else {})
    assert delivered(ledger) == 1


def test_every_altered_byte_is_seen(ledger: Ledger) -> None:
    frame = numbered_frame(1, 0)
    for at in range(len(frame)):
        before = ledger.faults.total()
        ledger.on_received("b", frame[:at] + bytes((frame[at] ^ 1,)) + frame[at + 1 :], 1.5)
        assert ledger.faults.total() > before
    assert delivered(ledger) == 0


def test_the_second_copy_is_a_replay(ledger: Ledger) -> None:
    for _ in range(2):
        ledger.on_received("b", numbered_frame(1, 0), 1.5)
    assert dict(ledger.faults) == {Fault.REPLAYED: 1}


def test_whom_it_was_not_for_gets_it_misrouted() -> None:
    """A frame that is genuine, at a drone that should not have it."""
    ledger = Ledger(("a", "b", "c"), {"a": {"b"}, "b": {"a"}, "c": set()})
    ledger.next_frame("a", 1.0)
    ledger.on_received("c", numbered_frame(1, 0), 1.5)
    assert dict(ledger.faults) == {Fault.MISROUTED: 1}


def test_recovery_counts_frames_sent_after_the_moment_alone(ledger: Ledger) -> None:
    ledger.await_recovery(2.0)
    ledger.on_received("b", numbered_frame(1, 0), 2.5)
    ledger.next_frame("a", 3.0)
    ledger.next_frame("b", 3.0)
    ledger.on_received("b", numbered_frame(1, 1), 3.25)
    assert ledger.recovery_s is None
    ledger.on_received("a", numbered_frame(2, 1), 3.5)
    assert ledger.recovery_s == 1.5


def test_lost_heartbeats_are_counted() -> None:
    """Frames 0, 20 and 40 are heartbeats; the second one is lost."""
    ledger = Ledger(("a", "b"), {"a": {"b"}, "b": set()})
    frames = [ledger.next_frame("a", 1.0) for _ in range(50)]
    for frame in (*frames[:20], *frames[30:]):
        ledger.on_received("b", frame, 1.5)
    end = ledger.mark()
    assert ledger.count_critical({"a": 0, "b": 0}, end) == (3, 2)
    assert ledger.count_critical({"a": 1, "b": 0}, end) == (2, 1)
    assert ledger.count({"a": 0, "b": 0}, end) == (50, 40)
    assert not ledger.faults
