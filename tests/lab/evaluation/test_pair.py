"""The pair of real daemons of a measurement."""

from __future__ import annotations

import pytest

from uavlinkd.core.suites import SUITES_BY_NAME, X25519
from uavlinkd.lab.evaluation.pair import LinkChoice, Pair, PairError, numbered_frame
from uavlinkd.mavlink.frames import SplitCounters, split_datagram


def test_frames_are_genuine_and_all_different() -> None:
    """ATTITUDE of 40 bytes, which the daemon takes for such; no router can take two for one."""
    frames = [numbered_frame(number) for number in (1, 2, 257, 70000)]
    assert len(set(frames)) == 4
    for raw in frames:
        (frame,) = split_datagram(raw, SplitCounters())
        assert (frame.header.msgid, frame.header.is_known, len(frame.raw)) == (30, True, 40)


def test_a_link_without_a_relay_carries_frames() -> None:
    """Two processes, linked; both have used processor time; both are gone afterwards."""
    with Pair(LinkChoice(X25519), with_relay=False) as pair:
        pair.wait_until_linked()
        assert all(seconds > 0 for seconds in pair.cpu_s())
        processes = [daemon._process for daemon in (pair.initiator, pair.responder)]
    assert all(process is not None and process.poll() is not None for process in processes)


def test_a_daemon_that_does_not_start_is_an_error_with_what_it_said() -> None:
    """The reason reaches the record: here a configuration that the daemon refuses."""
    with pytest.raises(PairError, match=r"ended with status 2: .*rekey_after_s"):
        Pair(LinkChoice(SUITES_BY_NAME["ffdhe2048"], rekey_after_s=0.0), with_relay=True).__enter__()
