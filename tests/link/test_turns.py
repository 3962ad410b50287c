"""Datagrams that wait: senders take turns, and what one may have waiting is bounded."""

from __future__ import annotations

from itertools import islice

from uavlinkd.core.path import Path
from uavlinkd.link.carrier import (
    SHARED_BYTES,
    STARTS_OF_A_FRAME,
    WAITING_BYTES,
    WAITING_OVERHEAD_BYTES,
    Turns,
    cost_of,
)

HERE = Path(0, ("192.0.2.1", 1))


def test_each_sender_has_one_turn_a_round() -> None:
    """A turn that ends early leaves the rest for the next round, in order; other senders come in between."""
    turns = Turns()
    for number in range(4):
        assert turns.put("loud", b"loud %d" % number, HERE, 0) == []
    turns.put("quiet", b"quiet", HERE, 0)

    rounds = [[[datagram for datagram, _ in islice(turn, 2)] for turn, _ in turns.round()] for _ in range(2)]
    assert rounds == [[[b"loud 0", b"loud 1"], [b"quiet"]], [[b"loud 2", b"loud 3"]]]
    assert not turns.queues


def test_what_one_sender_has_waiting_is_bounded() -> None:
    """The oldest goes, with its path; another sender keeps all of its own. Each has half of what they share."""
    turns = Turns()
    size = SHARED_BYTES // 8 - WAITING_OVERHEAD_BYTES
    turns.put("quiet", b"quiet", HERE, 0)
    for number in range(4):
        assert turns.put("loud", bytes((number,)) * size, HERE, 0) == []
    assert turns.put("loud", b"\4" * size, HERE, 0) == [(bytes(size), HERE)]

    assert [[datagram[0] for datagram, _ in turn] for turn, _ in turns.round()] == [[ord("q")], [1, 2, 3, 4]]


def test_empty_datagrams_are_bounded_too() -> None:
    """They have no bytes of their own, and anyone can send them."""
    turns = Turns()
    pushed_out = [turns.put(None, b"", HERE, 0) for _ in range(2 * SHARED_BYTES // WAITING_OVERHEAD_BYTES)]
    assert sum(map(len, pushed_out)) == SHARED_BYTES // WAITING_OVERHEAD_BYTES


def test_start_bytes_in_a_payload_cost_as_frames_do() -> None:
    """Each may begin a hidden frame. A frame's own start is in its price."""
    assert cost_of(bytes(40), 2) == 2
    assert cost_of(b"\xfd" + bytes(20) + b"\xfe" + bytes(20), 2) == 2
    assert cost_of(b"\xfd\xfe" + b"\xfd\xfe" * 2 * STARTS_OF_A_FRAME, 2) == 2 + 4


def test_the_largest_datagram_can_wait() -> None:
    """It pushes out the others of its sender, not itself."""
    turns = Turns()
    rivals = SHARED_BYTES // WAITING_BYTES - 1
    for number in range(rivals):
        turns.put(number, b"", HERE, 0)
    turns.put("one", bytes(100), HERE, 0)
    assert turns.put("one", bytes(65507), HERE, 0) == [(bytes(100), HERE)]
    assert [[len(datagram) for datagram, _ in turn] for turn, _ in turns.round()] == [[0]] * rivals + [[65507]]


def test_a_turn_is_of_one_epoch() -> None:
    """What was read before a pause of this process is not handled together with what was read after it."""
    turns = Turns()
    for epoch, datagram in (0, b"old"), (0, b"older"), (1, b"new"):
        turns.put("one", datagram, HERE, epoch)

    rounds = [[([datagram for datagram, _ in turn], epoch) for turn, epoch in turns.round()] for _ in range(2)]
    assert rounds == [[([b"old", b"older"], 0)], [([b"new"], 1)]]
