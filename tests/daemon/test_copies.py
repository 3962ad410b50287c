"""Copies of envelopes for other paths: at once, later, replaced, or dropped, within what they may use."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.samples import attitude, battery, command, heartbeat, manual_control, parameter, raws
from uavlinkd.daemon.copies import DEBT_S, LEAST_BITS_S, MAX_WAIT_S, MAX_WAITING_BYTES, Copies
from uavlinkd.daemon.journal import ShellReason
from uavlinkd.daemon.networks import NetworkBudget, wire_bytes
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathState

SLOW_BITS_S = 8000
SEAL_BYTES = 23
FREE, SLOW, OTHER = PATHS = tuple(
    PathState(Path(number, (f"192.0.{number}.2", 14600)), number, 0.0, is_configured=True, is_metered=False)
    for number in range(3)
)


def envelope(frames: Sequence[Frame]) -> bytes:
    """One envelope with these frames."""
    return bytes(SEAL_BYTES) + b"".join(raws(frames))


def size_along(path: PathState, datagram: bytes) -> int:
    """What a datagram costs the network of a path."""
    return wire_bytes(datagram, path.path)


class Scene:
    """A peer with a free network and a slow one, and a daemon that sends and charges. ``spent``: on the slow one."""

    def __init__(self, budgets: dict[int, int] | None = None, spent: int = 0) -> None:
        limits = {SLOW.number: SLOW_BITS_S} if budgets is None else budgets
        self.budgets = {number: NetworkBudget(bits_s, 0.0) for number, bits_s in limits.items()}
        self.copies = Copies(self.budgets, 0.0)
        self.sent: list[tuple[float, PathState, bytes]] = []
        self.now = 0.0
        if spent:
            self.spend(SLOW, spent, 0.0)

    def spend(self, path: PathState, size: int, now: float) -> None:
        """Something else uses the network."""
        self.budgets[path.number].all.spend(size, now)

    def send(
        self,
        frames: Sequence[Frame],
        now: float,
        *paths: PathState,
        is_critical: bool = True,
        other: Copies | None = None,
    ) -> list[PathState]:
        """Send an envelope along these paths, or the free one and the slow one. Returns where it went at once."""
        self.now, copies, datagram = now, other or self.copies, envelope(frames)
        along, later = copies.divide(paths or (FREE, SLOW), now)
        copies.add(datagram, along, later, frames if is_critical else None, 1, now)
        for path in along:
            self._send(path, datagram, now)
        return list(along)

    def release(self, copies: Copies, now: float, usable: Sequence[PathState] = PATHS) -> None:
        """Send what is due."""
        for path, datagram, _ in copies.release(usable, (), now):
            self._send(path, datagram, now)

    def run(self, until: float) -> None:
        """Let time pass: copies are released at their deadlines and never else."""
        for _ in range(10_000):
            deadline = self.copies.next_deadline(self.now)
            if deadline > until:
                self.now = until
                return
            self.now = max(self.now, deadline)
            self.release(self.copies, self.now)
        raise AssertionError("deadlines without end")

    def _send(self, path: PathState, datagram: bytes, now: float) -> None:
        self.sent.append((now, path, datagram))
        if path.number in self.budgets:
            self.spend(path, size_along(path, datagram), now)

    def datagrams(self, path: PathState) -> list[bytes]:
        """What went along a path."""
        return [datagram for _, along, datagram in self.sent if along is path]

    def along(self, path: PathState, *frames: Frame) -> list[float]:
        """When envelopes with one of these frames went along a path."""
        return [
            now
            for now, along, datagram in self.sent
            if along is path and any(frame.raw in datagram for frame in frames)
        ]


def test_copy_waits_for_its_network_and_then_goes() -> None:
    """The slow network is in debt by more than a quarter of a second."""
    scene = Scene(spent=1000)  # 0.6 s of debt after its burst
    assert scene.send([command(1)], 0.0) == [FREE]
    assert scene.copies.count == 1
    scene.run(1.0)
    (at,) = scene.along(SLOW, command(1))
    assert at == pytest.approx(0.6 - DEBT_S, abs=0.01)
    assert scene.copies.count == 0


def test_copy_goes_at_once_on_a_network_in_little_debt() -> None:
    """A command must not wait for the end of every small debt."""
    scene = Scene()
    scene.spend(SLOW, 400 + round(0.9 * DEBT_S * SLOW_BITS_S / 8), 0.0)
    assert scene.send([command(1)], 0.0) == [FREE, SLOW]


def test_copy_that_waited_too_long_is_dropped() -> None:
    """What it carries has arrived along the other path, or comes again."""
    scene = Scene(spent=1400)
    scene.send([command(1)], 0.0)
    scene.run(MAX_WAIT_S - 0.01)
    assert scene.copies.count == 1
    scene.run(5.0)
    assert scene.along(SLOW, command(1)) == []
    assert scene.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 1}


def test_copy_for_a_path_that_is_gone_is_dropped() -> None:
    """At once: nothing leaves along a slot that is not in use any more."""
    scene = Scene(spent=1000)
    scene.send([command(1)], 0.0)
    scene.release(scene.copies, 0.01, (FREE,))
    assert scene.along(SLOW, command(1)) == []
    assert scene.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 1}


def test_first_datagram_of_an_envelope_goes_where_there_is_room() -> None:
    """The best path's network is far in debt: its datagram waits as the copy of the other one."""
    scene = Scene(spent=1000)
    assert scene.send([command(1)], 0.0, SLOW, FREE) == [FREE]
    scene.run(1.0)
    assert len(scene.along(SLOW, command(1))) == 1


def test_envelope_without_room_anywhere_goes_along_the_best_path() -> None:
    """It was sealed when there was room, which something else used up since."""
    scene = Scene({SLOW.number: SLOW_BITS_S, OTHER.number: SLOW_BITS_S})
    scene.spend(SLOW, 1500, 0.0)
    scene.spend(OTHER, 1500, 0.0)
    assert scene.send([command(1)], 0.0, SLOW, OTHER) == [SLOW]


def test_newer_states_replace_a_waiting_copy_of_states() -> None:
    """Only the newest joystick position is worth the slow network."""
    scene = Scene(spent=1000)
    for number in range(5):
        scene.send([manual_control(number)], number * 0.04)
    assert scene.copies.count == 1
    scene.run(1.0)
    assert scene.along(SLOW, *map(manual_control, range(4))) == []
    assert len(scene.along(SLOW, manual_control(4))) == 1
    assert scene.copies.dropped == {ShellReason.COPY_REPLACED: 4}


@pytest.mark.parametrize(
    ("waiting", "newer"),
    [
        ([command(1)], [command(2)]),
        ([manual_control(1), command(1)], [manual_control(2)]),
        ([manual_control(1), heartbeat(1)], [manual_control(2)]),
        ([battery(1, 0)], [battery(2, 1)]),
        ([manual_control(1)], [heartbeat(1)]),
    ],
    ids=["events", "an event too", "another state too", "another instance", "another state"],
)
def test_newer_envelope_does_not_replace_what_it_does_not_contain(waiting: list[Frame], newer: list[Frame]) -> None:
    """A copy is dropped for a newer one only if that has all its flows, and no event is lost with it."""
    scene = Scene(spent=1000)
    scene.send(waiting, 0.0)
    scene.send(newer, 0.01)
    assert scene.copies.count == 2


def test_commands_and_heartbeats_go_before_other_events_and_states() -> None:
    """Whatever came first."""
    scene = Scene(spent=1000)
    for number, frames in enumerate(([manual_control(1)], [parameter(1)], [heartbeat(1)], [command(1)])):
        scene.send(frames, number / 100)
    scene.run(1.0)
    times = [scene.along(SLOW, frame) for frame in (heartbeat(1), command(1), parameter(1), manual_control(1))]
    assert [len(at) for at in times] == [1, 1, 1, 1]
    expected = raws([heartbeat(1), command(1), parameter(1), manual_control(1)])
    assert [datagram[SEAL_BYTES:] for datagram in scene.datagrams(SLOW)] == expected


def test_copy_does_not_overtake_those_that_wait() -> None:
    """A new command waits behind an older one."""
    scene = Scene(spent=1000)
    scene.send([command(1)], 0.0)
    assert scene.send([command(2)], 0.45) == [FREE]
    scene.run(1.0)
    assert scene.along(SLOW, command(1)) <= scene.along(SLOW, command(2))


def test_copies_of_all_peers_use_half_of_a_budget() -> None:
    """Two peers with more commands than the slow network carries. Half of it is left for what only it carries."""
    scene = Scene()
    other = Copies(scene.budgets, 0.0)
    seconds = 20
    for tick in range(50 * seconds):
        now = tick / 50
        scene.send([command(tick)], now)
        scene.send([command(-tick)], now, other=other)
        scene.run(now)
        scene.release(other, now)
    used = sum(size_along(SLOW, datagram) for datagram in scene.datagrams(SLOW))
    half = SLOW_BITS_S / 8 / 2 * seconds
    assert 0.9 * half < used < half + 600
    assert scene.copies.dropped[ShellReason.COPY_OVER_BUDGET] > 0


@pytest.mark.parametrize(
    ("stream_bytes_s", "bytes_s"),
    [
        (0, LEAST_BITS_S / 8),
        pytest.param(3000, LEAST_BITS_S / 8, marks=pytest.mark.long),
        pytest.param(20_000, 20_000, marks=pytest.mark.long),
    ],
)
def test_copies_use_at_most_the_rate_of_the_stream_or_64_kbit_s(stream_bytes_s: int, bytes_s: float) -> None:
    """On networks without a budget."""
    scene = Scene({})
    scene.copies.set_stream_rate(stream_bytes_s, 0.0)
    seconds = 10
    for tick in range(400 * seconds):
        now = tick / 400
        scene.send([command(tick)], now)
        scene.run(now)
    used = sum(size_along(SLOW, datagram) for datagram in scene.datagrams(SLOW))
    assert 0.95 * bytes_s * seconds < used < bytes_s * (seconds + 0.5)


def test_copies_of_the_stream_do_not_wait() -> None:
    """The best path is suspect, so the stream goes along the slow one too, as far as that has room."""
    scene = Scene()
    assert scene.send([attitude(1)], 0.0, FREE, SLOW, is_critical=False) == [FREE, SLOW]
    scene.spend(SLOW, 1500, 0.0)
    assert scene.send([attitude(2)], 0.0, FREE, SLOW, is_critical=False) == [FREE]
    assert scene.copies.count == 0
    assert scene.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 1}


def test_waiting_copies_are_bounded_and_the_least_important_go_first() -> None:
    """Different parameters, none of which replaces another, and one command."""
    scene = Scene(spent=1400)
    scene.send([command(1)], 0.0)
    parameters = [parameter(number) for number in range(200)]
    for sent in parameters:
        scene.send([sent], 0.0)
    size = scene.copies.count * (SEAL_BYTES + len(parameter(1).raw))
    assert MAX_WAITING_BYTES - 200 < size <= MAX_WAITING_BYTES + 50
    waiting = scene.copies.waiting
    assert command(1).raw in waiting[0].datagram
    assert parameters[-1].raw in waiting[-1].datagram
    assert scene.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 201 - scene.copies.count}


MAKERS = (command, heartbeat, manual_control, parameter, attitude)


@given(st.lists(st.tuples(st.lists(st.sampled_from(MAKERS), min_size=1, max_size=3), st.floats(0, 0.3)), max_size=50))
def test_every_copy_is_sent_once_or_counted(offers: list[tuple[list[object], float]]) -> None:
    """Whatever is offered: each envelope goes along one path at once, and its copy has one fate."""
    scene = Scene()
    now, first = 0.0, 0
    for number, (makers, pause) in enumerate(offers):
        now += pause
        scene.run(now)
        frames = [maker(number) for maker in makers]  # type: ignore[operator]
        first += FREE in scene.send(frames, now)
    scene.run(now + 5)
    assert first == len(offers)
    assert len(scene.datagrams(SLOW)) + scene.copies.dropped.total() == len(offers)
