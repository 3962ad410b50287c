"""What waits for one slow client: each source its share, urgent frames first, the newest state, all of it bounded."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from itertools import groupby

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.policies import TRUSTED
from tests.samples import attitude, battery, command, file_part, heartbeat, manual_control, parameter
from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.egress.fair_queue import (
    LANE_BYTES,
    MAX_SOURCES,
    MOST_AHEAD,
    QUEUE_BYTES,
    SUPERSEDED_S,
    FairQueue,
)
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.flows import flow_key
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source

GATE = Policy(TRUSTED).incoming
HONEST, CAPTURED = Source("honest", GATE), Source("captured", GATE)


def make() -> tuple[FairQueue, Counter[EgressDrop]]:
    dropped: Counter[EgressDrop] = Counter()

    def on_drop(reason: EgressDrop) -> None:
        dropped[reason] += 1

    return FairQueue(on_drop), dropped


def popped(queue: FairQueue, byte_count: float = 1e9, now: float = 0.0) -> list[tuple[Frame, Source]]:
    """What leaves until so many bytes have gone."""
    gone = []
    while byte_count > 0 and (one := queue.pop(1e9, now)) is not None:
        gone.append(one)
        byte_count -= len(one[0].raw)
    return gone


def bytes_by_source(gone: list[tuple[Frame, Source]]) -> Counter[Source]:
    sums: Counter[Source] = Counter()
    for item, source in gone:
        sums[source] += len(item.raw)
    return sums


def test_urgent_frame_that_waits_longest_goes_first() -> None:
    """A flow that was sent long ago has no lead over one that has waited."""
    queue, _ = make()
    queue.put([heartbeat(0, 2)], HONEST, 0.0)
    assert popped(queue) == [(heartbeat(0, 2), HONEST)]
    queue.put([heartbeat(1, 3)], HONEST, 5.0)
    queue.put([heartbeat(1, 2)], HONEST, 6.0)
    assert popped(queue, now=6.0) == [(heartbeat(1, 3), HONEST), (heartbeat(1, 2), HONEST)]


def test_frame_that_does_not_fit_stays() -> None:
    """The frame whose turn it is goes next, or none does."""
    queue, _ = make()
    queue.put([parameter(0)], HONEST, 0.0)
    size = len(parameter(0).raw)
    assert queue.next_bytes(0.0) == size
    assert queue.pop(size - 1, 0.0) is None
    assert queue.pop(size, 0.0) == (parameter(0), HONEST)
    assert (queue.next_bytes(0.0), queue.count, queue.size) == (0, 0, 0)


@pytest.mark.parametrize(
    "flood",
    [
        lambda n: attitude(n, n % 200 + 1),
        lambda n: battery(n, n % 250),
        parameter,
        file_part,
        lambda n: heartbeat(n, 2, n % 250 + 1),
        lambda n: (heartbeat, attitude)[n % 2](n, n % 12 + 1),
    ],
)
def test_sources_share_by_bytes(flood: Callable[[int], Frame]) -> None:
    """Half of the bytes each, however large or urgent the frames are, and however many flows one source invents."""
    queue, _ = make()
    queue.put([flood(number) for number in range(400)], CAPTURED, 0.0)
    queue.put([parameter(number) for number in range(400)], HONEST, 0.0)
    sums = bytes_by_source(popped(queue, 8000))
    assert abs(sums[HONEST] - sums[CAPTURED]) <= 300


def test_urgent_frames_have_half_of_the_line_beside_many_sources() -> None:
    """A joystick is not reduced to the share of one of fifty members. Its other frames do not pay for that later."""
    queue, _ = make()
    for member in range(50):
        queue.put([parameter(number) for number in range(20)], Source(f"member{member}", GATE), 0.0)
    queue.put([manual_control(number) for number in range(300)], HONEST, 0.0)
    assert bytes_by_source(popped(queue, 8000))[HONEST] == pytest.approx(4000, abs=300)
    queue.clear()
    queue.put([parameter(number) for number in range(400)], CAPTURED, 0.0)
    queue.put([parameter(0)], HONEST, 0.0)
    assert HONEST in bytes_by_source(popped(queue, MOST_AHEAD + MAX_FRAME_BYTES))


def test_many_sources_of_other_frames_delay_urgent_ones_by_a_frame() -> None:
    """However many sources sent urgent frames before, at the same time."""
    queue, _ = make()
    for name, make_frame in (
        *((f"operator{n}", command) for n in range(20)),
        *((f"member{n}", parameter) for n in range(50)),
    ):
        queue.put([make_frame(number) for number in range(20)], Source(name, GATE), 0.0)
    runs = groupby(popped(queue, 8000), key=lambda one: one[0].header.kind.lane is Lane.URGENT)
    others = [sum(len(item.raw) for item, _ in run) for is_urgent, run in runs if not is_urgent]
    assert 0 < max(others) <= MOST_AHEAD + MAX_FRAME_BYTES


def test_source_that_was_idle_has_saved_nothing_up() -> None:
    """After a pause a source gets its share, not what it did not ask for before."""
    queue, _ = make()
    queue.put([parameter(number) for number in range(500)], CAPTURED, 0.0)
    popped(queue, 8000)
    queue.put([parameter(number) for number in range(200)], HONEST, 0.0)
    sums = bytes_by_source(popped(queue, 4000))
    assert abs(sums[HONEST] - sums[CAPTURED]) <= 100


@pytest.mark.parametrize(
    ("waiting", "one", "looks"),
    [([parameter(n) for n in range(400)], file_part, False), ([file_part(n) for n in range(40)], parameter, True)],
)
def test_source_that_empties_its_queue_again_and_again_gains_nothing(
    waiting: list[Frame], one: Callable[[int], Frame], looks: bool
) -> None:
    """A source with one frame at a time pays for each: it does not rejoin in front.

    A stream that waits for room looks whose turn it is: an idle source leaves the line, and keeps its debt.
    """
    queue, _ = make()
    queue.put(waiting, HONEST, 0.0)
    sums: Counter[Source] = Counter()
    for number in range(200 if looks else 100):
        if looks:
            queue.next_bytes(0.0)
        if CAPTURED not in waiting_sources(queue):
            queue.put([one(number)], CAPTURED, 0.0)
        sums += bytes_by_source(popped(queue, 1))
    assert abs(sums[HONEST] - sums[CAPTURED]) <= 300


def waiting_sources(queue: FairQueue) -> set[Source]:
    return {source for source, waiting in queue._sources.items() if waiting.lanes.count}


def test_newest_state_wins() -> None:
    """A state that has waited is replaced by a newer one, which keeps its turn; other flows are not touched."""
    queue, dropped = make()
    queue.put([attitude(0), attitude(0, 3), command(0)], HONEST, 0.0)
    queue.put([attitude(1)], HONEST, SUPERSEDED_S + 0.01)
    queue.put([attitude(2)], HONEST, SUPERSEDED_S + 0.02)
    gone = popped(queue, now=SUPERSEDED_S + 0.02)
    assert [item for item, _ in gone] == [command(0), attitude(1), attitude(0, 3), attitude(2)]
    assert dropped == {EgressDrop.THINNED: 1}


def test_states_that_came_together_are_not_thinned() -> None:
    """One envelope may carry several of a flow: they go where there is room for all."""
    queue, dropped = make()
    queue.put([attitude(number) for number in range(5)], HONEST, 0.0)
    assert [item for item, _ in popped(queue)] == [attitude(number) for number in range(5)]
    assert not dropped


def test_flood_drops_its_own_oldest_frames() -> None:
    """A source that floods loses its oldest; what another source has waiting stays, to the last frame."""
    queue, dropped = make()
    honest = [parameter(number) for number in range(50)]
    queue.put(honest, HONEST, 0.0)
    flood = [attitude(number, number % 250 + 1) for number in range(5000)]
    queue.put(flood, CAPTURED, 0.0)
    assert queue.size <= LANE_BYTES + sum(len(item.raw) for item in honest)
    gone = popped(queue)
    assert [item for item, source in gone if source is HONEST] == honest
    left = [item for item, source in gone if source is CAPTURED]
    assert sorted(map(flood.index, left)) == list(range(5000 - len(left), 5000))
    assert dropped == {EgressDrop.OVERFLOW: 5000 - len(left)}


@pytest.mark.long
def test_queue_is_bounded_over_all_sources() -> None:
    """Many sources that flood together are bounded too, and the one that asks for little loses nothing."""
    queue, _ = make()
    honest = [parameter(number) for number in range(50)]
    queue.put(honest, HONEST, 0.0)
    for captured in range(10):
        flooding = Source(f"captured{captured}", GATE)
        for lane in (lambda n: heartbeat(n, 2, n % 250 + 1), file_part, lambda n: attitude(n, n % 250 + 1)):
            queue.put([lane(number) for number in range(1500)], flooding, 0.0)
            assert queue.size <= QUEUE_BYTES
    assert [item for item, source in popped(queue) if source is HONEST] == honest


def test_stale_frames_are_dropped_when_their_turn_comes() -> None:
    """They are counted as stale, not as overflow, and take no turn."""
    queue, dropped = make()
    queue.put([file_part(number) for number in range(100)], CAPTURED, 0.0)
    queue.put([file_part(number) for number in range(100)], CAPTURED, 1.5)
    assert dropped == {EgressDrop.STALE: 100}
    queue.put([parameter(0)], HONEST, 2.6)
    assert queue.pop(1e9, 2.6) == (parameter(0), HONEST)
    assert queue.next_bytes(2.6) == 0
    assert dropped == {EgressDrop.STALE: 200}


def test_sources_that_are_gone_are_forgotten() -> None:
    """Clients of a listening endpoint come and go, each a source."""
    queue, _ = make()
    for number in range(5 * MAX_SOURCES):
        queue.put([heartbeat(number), attitude(number)], Source(str(number), GATE), 0.0)
        assert len(popped(queue)) == 2
    assert len(queue._sources) <= 2 * MAX_SOURCES


SOURCES = [HONEST, CAPTURED, Source("third", GATE)]
FRAMES: list[Callable[[int], Frame]] = [
    lambda n: attitude(n, n % 3 + 1),
    lambda n: heartbeat(n, 1, n % 4 + 1),
    lambda n: command(n, 255 - n % 2),
    lambda n: battery(n, n % 5),
    parameter,
    file_part,
]
STEPS = st.lists(
    st.tuples(st.just("put"), st.integers(0, 2), st.integers(0, 5), st.integers(1, 40))
    | st.tuples(st.just("pop"), st.just(0), st.just(0), st.integers(1, 60))
    | st.tuples(st.just("wait"), st.just(0), st.just(0), st.sampled_from([1, 50, 150, 600, 1200])),
    max_size=40,
)


@given(STEPS)
def test_each_frame_leaves_once_and_flows_keep_their_order(steps: list[tuple[str, int, int, int]]) -> None:
    """Whatever comes and goes: popped, dropped and waiting frames are all there are, and no flow is reordered."""
    queue, dropped = make()
    now, put_count = 0.0, 0
    put_order: dict[int, int] = {}
    gone: list[tuple[Frame, Source]] = []
    kept: list[Frame] = []  # so that no id is used twice
    for step, which, kind, count in steps:
        if step == "put":
            frames = [FRAMES[kind](put_count + number) for number in range(count)]
            for item in frames:
                put_order[id(item)] = len(put_order)
            put_count += count
            queue.put(frames, SOURCES[which], now)
            kept.extend(frames)
        elif step == "pop":
            gone += popped(queue, count * 10, now)
        else:
            now += count / 1000
        assert put_count == len(gone) + dropped.total() + queue.count
        assert queue.size == sum(waiting.lanes.size for waiting in queue._sources.values())
    gone += popped(queue, now=now)
    assert put_count == len(gone) + dropped.total()
    last: dict[object, int] = defaultdict(lambda: -1)
    for item, source in gone:
        flow = (source, flow_key(item))
        assert put_order[id(item)] > last[flow]
        last[flow] = put_order[id(item)]
