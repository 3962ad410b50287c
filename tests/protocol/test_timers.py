"""The timers of a peer, and the order of all peers by their next one."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.protocol.timers import MIN_ENTRIES, Schedule, Timer, TimerTable


class Stub:
    """A peer that has timers alone."""

    def __init__(self) -> None:
        self.timers = TimerTable()


MOMENTS = st.integers(0, 8).map(float)


@given(
    st.lists(st.tuples(st.sampled_from(["set", "stop", "pop", "remove"]), st.integers(0, 4), MOMENTS), max_size=60)
)
def test_schedule_wakes_every_peer_in_time(steps: list[tuple[str, int, float]]) -> None:
    """Whatever is set, stopped and removed: the next moment is never late, and exact after a wake-up."""
    schedule, peers, removed = Schedule[Stub](), [Stub() for _ in range(5)], set[int]()
    now = 0.0
    for what, number, moment in steps:
        peer = peers[number]
        if what == "set" and number not in removed:
            peer.timers.set(Timer.INITIATE, now + moment)
            schedule.update(peer)
        elif what == "stop":
            peer.timers.stop(Timer.INITIATE)
        elif what == "remove":
            peer.timers.stop_all()
            schedule.remove(peer)
            removed.add(number)
            assert all(entry[2] is not peer for entry in schedule._heap)
        else:
            now += moment
            due = schedule.pop(now)
            assert {id(peer) for peer in due} == {id(peer) for peer in peers if peer.timers.next_at <= now}
            for peer in due:
                assert list(peer.timers.expired(now)) == [Timer.INITIATE]
                schedule.update(peer)
            assert schedule.next_at == min(peer.timers.next_at for peer in peers)
        assert schedule.next_at <= min(peer.timers.next_at for peer in peers)


def test_replaced_entries_do_not_gather() -> None:
    """Each silence that ends schedules the same far moment again, behind the next moment of another peer."""
    schedule, peer, other = Schedule[Stub](), Stub(), Stub()
    peer.timers.set(Timer.KEEPALIVE, 3600.0)
    for step in range(1000):
        now = 0.5 * step
        peer.timers.set(Timer.SILENCE, now + 0.5)
        schedule.update(peer)
        other.timers.set(Timer.INITIATE, now + 0.75)
        schedule.update(other)
        assert schedule.next_at <= now + 0.5
        assert schedule.pop(now + 0.5) == [peer]
        peer.timers.stop(Timer.SILENCE)
        schedule.update(peer)
        assert len(schedule._heap) <= MIN_ENTRIES
    other.timers.stop_all()
    assert schedule.pop(3600.0) == [peer]
