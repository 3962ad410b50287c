"""When critical envelopes are repeated, how often, within what, and what arrives then."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import pytest

from tests.link.two_radios import Network, Radio
from tests.mavlink.egress.samples import attitude, command, heartbeat, parameter
from tests.mavlink.test_newest import manual_control
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathState
from uavlinkd.core.settings import Link, Redundancy
from uavlinkd.link.copies import AVERAGE_S, LEAST_BITS_S, MAX_WAIT_S, Copies
from uavlinkd.link.network_budgets import NetworkBudget
from uavlinkd.link.repair import HOLD_S, Repair, transmissions_for
from uavlinkd.link.repeats import MAX_ENVELOPES, SPACING_S, Repeats
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.mavlink.frames import Frame

HERE, THERE = Path(0, ("192.0.2.1", 14600)), Path(1, ("192.0.2.2", 14600))


class _Lossy:
    """A path of which only the loss is known."""

    def __init__(self, loss: float, lost: int = 100) -> None:
        self.facts = loss, lost

    def loss_to_repair(self) -> tuple[float, int]:
        """As of a path."""
        return self.facts


def paths(*lossy: _Lossy) -> Sequence[PathState]:
    """As the state of repair wants them."""
    return cast(Sequence[PathState], lossy)


@pytest.mark.parametrize(
    ("loss", "times"), [(0.0, 1), (0.005, 1), (0.05, 2), (0.1, 3), (0.2, 4), (0.3, 5), (0.6, 5), (1.0, 5)]
)
def test_transmissions_leave_half_a_percent(loss: float, times: int) -> None:
    """As far as five do."""
    assert transmissions_for(loss) == times


def test_repair_begins_above_two_percent_and_ends_below_one_for_a_while() -> None:
    """Between them it stays as it is; the highest loss of the last 10 s decides."""
    repair, now = Repair(), 0.0
    for loss, is_on in ((0.02, False), (0.025, True), (0.015, True), (0.3, True), (0.015, True)):
        repair.update(paths(_Lossy(loss)), now, is_allowed=True)
        assert repair.is_on is is_on
        now += 1.0
    assert repair.transmissions == 5
    for _ in range(int(HOLD_S)):
        repair.update(paths(_Lossy(0.015)), now, is_allowed=True)
        now += 1.0
    assert (repair.is_on, repair.transmissions) == (True, 2)
    for _ in range(int(HOLD_S)):
        assert repair.is_on
        repair.update(paths(_Lossy(0.0)), now, is_allowed=True)
        now += 1.0
    assert (repair.is_on, repair.transmissions) == (False, 1)


def test_paths_together_decide() -> None:
    """Two paths that lose a tenth each lose a hundredth together; without a path there is no estimate."""
    repair = Repair()
    repair.update(paths(_Lossy(0.1), _Lossy(0.1)), 0.0, is_allowed=True)
    repair.update((), 1.0, is_allowed=True)
    assert repair.transmissions == 1
    repair.update(paths(_Lossy(0.2), _Lossy(0.2)), 2.0, is_allowed=True)
    assert repair.transmissions == 2


def test_two_lost_envelopes_say_nothing() -> None:
    """Repair begins with three."""
    repair = Repair()
    states: list[bool] = []
    for lost, is_allowed in ((2, True), (3, True), (3, False)):
        repair.update(paths(_Lossy(0.5, lost)), float(len(states)), is_allowed=is_allowed)
        states.append(repair.is_on)
    assert states == [False, True, False]


class Scene:
    """Repeats of one peer, sent at their deadlines."""

    def __init__(self, budgets: dict[int, NetworkBudget] | None = None) -> None:
        self.copies = Copies(budgets or {}, 0.0)
        self.repeats = Repeats(self.copies)
        self.sent: list[tuple[float, bytes, int]] = []

    def put(self, name: bytes, frames: Sequence[Frame], now: float, times: int = 5, along: Path = HERE) -> None:
        """An envelope was sent."""
        self.repeats.put(name.ljust(100, b"."), [along], frames, times, now)

    def run(self, now: float, until: float) -> None:
        """Let time pass."""
        for _ in range(100_000):
            now = max(now, self.repeats.next_deadline(now))
            if now > until:
                return
            for transmit, number in self.repeats.release((HERE, THERE), now):
                self.sent.append((round(now, 4), transmit.datagram.rstrip(b"."), number))
        raise AssertionError("deadlines without end")


def test_repeats_are_spaced_and_numbered() -> None:
    """20 ms apart, five transmissions in all; then nothing waits."""
    scene = Scene()
    scene.put(b"a", [command(1)], 1.0)
    scene.run(1.0, 5.0)
    assert scene.sent == [(round(1.0 + (n - 1) * SPACING_S, 4), b"a", n) for n in (2, 3, 4, 5)]
    assert not scene.repeats.is_waiting
    assert (scene.repeats.sent, scene.repeats.bytes_sent) == (4, 4 * 128)


def test_newer_state_replaces_repeats_of_an_older_one() -> None:
    """A vehicle never gets an older joystick position after a newer one."""
    scene = Scene()
    scene.put(b"old", [manual_control(1)], 0.0)
    scene.put(b"event", [command(1)], 0.0)
    scene.put(b"new", [manual_control(2)], 0.01)
    scene.run(0.01, 1.0)
    assert {name for _, name, _ in scene.sent} == {b"event", b"new"}
    assert scene.copies.dropped == {ShellReason.COPY_REPLACED: 1}


def test_newer_command_replaces_no_repeats_of_an_older_one() -> None:
    """Both must arrive. The older one may be the later one to do so, by less than half a second."""
    scene = Scene()
    scene.put(b"arm", [command(1)], 0.0)
    scene.put(b"take off", [command(2)], 0.01)
    scene.run(0.01, 1.0)
    assert [number for _, name, number in scene.sent if name == b"arm"] == [2, 3, 4, 5]
    assert [number for _, name, number in scene.sent if name == b"take off"] == [2, 3, 4, 5]
    assert scene.copies.dropped == {}


def test_commands_go_first_and_old_repeats_are_dropped() -> None:
    """On a network whose budget is used up."""
    scene = Scene({0: (budget := NetworkBudget(8000, 0.0))})
    budget.copies.spend(500, 0.0)
    for name, frame in ((b"state", manual_control(1)), (b"event", parameter(1)), (b"command", command(1))):
        scene.put(name, [frame], 0.0)
    scene.run(0.0, 2.0)
    assert [name for _, name, _ in scene.sent][:1] == [b"command"]
    assert scene.sent[0][0] > SPACING_S
    assert all(at < MAX_WAIT_S for at, _, _ in scene.sent)
    assert scene.copies.dropped[ShellReason.COPY_OVER_BUDGET] > 0
    assert not scene.repeats.is_waiting


def test_copies_that_wait_for_a_path_go_before_its_repeats() -> None:
    """They carry what has not gone there yet."""
    scene = Scene({1: (budget := NetworkBudget(8000, 0.0))})
    budget.all.spend(1000, 0.0)
    assert len(scene.copies.pick([Transmit(b"x", HERE), Transmit(b"x", THERE, is_copy=True)], [command(1)], 0.0)) == 1
    scene.put(b"a", [command(1)], 0.0, along=THERE)
    assert scene.repeats.release((HERE, THERE), 0.1) == []


def test_repeats_behind_copies_that_wait_need_no_polling() -> None:
    """The rate of copies is used up, the network's budget is not: the next deadline is that of the copies."""
    scene = Scene()
    pair = [Transmit(bytes(1000), HERE), Transmit(bytes(1000), THERE, is_copy=True)]
    for _ in range(3):
        scene.copies.charge(pair[1], 0.0)
    assert len(scene.copies.pick(pair, [command(1)], 0.0)) == 1
    scene.put(b"a", [command(1)], 0.0, along=THERE)
    now, wakeups = 0.0, 0
    while scene.repeats.is_waiting:
        now = min(scene.copies.next_deadline(now), scene.repeats.next_deadline(now))
        scene.copies.release(now)
        scene.sent += [(now, b"a", number) for _, number in scene.repeats.release((THERE,), now)]
        wakeups += 1
    assert [number for _, _, number in scene.sent] == [2, 3, 4, 5]
    assert scene.sent[0][0] > 2 * SPACING_S
    assert wakeups <= 7


def test_nothing_is_repeated_along_a_path_that_is_gone() -> None:
    """It is not counted either. An envelope without a path ends."""
    scene = Scene()
    scene.repeats.put(b"both", [HERE, THERE], [command(1)], 5, 0.0)
    scene.repeats.put(b"there", [THERE], [command(1)], 5, 0.0)
    (repeat,) = scene.repeats.release((HERE,), SPACING_S)
    assert (repeat.transmit.datagram, repeat.transmit.path) == (b"both", HERE)
    assert (scene.repeats.sent, scene.repeats.count) == (1, 1)
    assert scene.repeats.release((), 1.0) == []
    assert not scene.repeats.is_waiting


def test_rate_of_repeats_is_limited_on_average() -> None:
    """And at most so many envelopes wait: the least important one is dropped."""
    scene = Scene()
    for tick in range(3000):
        scene.put(b"%d" % tick, [command(tick)], tick / 100)
        scene.run(tick / 100, (tick + 1) / 100)
    assert scene.repeats.count <= MAX_ENVELOPES
    assert 0.95 * 30 <= scene.repeats.bytes_sent / (LEAST_BITS_S / 8) <= 30.5 + AVERAGE_S
    many = Scene()
    for tick in range(MAX_ENVELOPES + 10):
        many.put(b"%d" % tick, [command(tick)], 0.0)
    assert many.repeats.count == MAX_ENVELOPES
    assert many.copies.dropped == {ShellReason.COPY_OVER_BUDGET: 10}
    many.repeats.clear()
    assert not many.repeats.is_waiting


def in_use(network: Network, seconds: float) -> None:
    """Telemetry in one direction, a heartbeat and a command a second in both."""
    network.establish()
    for tick in range(int(seconds * 20)):
        network.alpha.send(attitude(tick))
        if tick % 20 == 0:
            for end in (network.alpha, network.bravo):
                end.send(heartbeat(tick % 250))
                end.send(command(tick))
        network.run(network.now + 0.05)


def test_lossy_path_is_repaired_and_repair_keeps_on() -> None:
    """The estimate does not count repaired frames as delivered datagrams, so repair does not switch itself off."""
    network = Network([Radio(0.01, 0.3)], seed=3)
    in_use(network, 20.0)
    for _ in range(30):
        in_use(network, 2.0)
        assert network.alpha.link.is_repairing
        assert network.bravo.link.is_repairing
    state = network.alpha.peer.paths.best
    assert state is not None
    assert state.loss_out == pytest.approx(0.3, abs=0.15)
    commands = [frame for frame in network.bravo.delivered if frame.header.msgid == 76]
    assert len(commands) >= 0.9 * 80
    assert network.bravo.peer.traffic.drops[DropReason.DUPLICATE] > 100
    assert network.bravo.peer.traffic.drops[DropReason.REPLAYED] == 0


def test_repair_ends_when_the_path_is_clean_again() -> None:
    """After the windows of estimate and hysteresis."""
    network = Network([Radio(0.01, 0.3)])
    in_use(network, 20.0)
    assert network.alpha.link.is_repairing
    network.radios[0] = Radio(0.01)
    in_use(network, 25.0)
    assert network.alpha.link.output.repair.transmissions == 1
    repeated = network.alpha.link.output.repeats.sent
    in_use(network, 3.0)
    assert network.alpha.link.output.repeats.sent == repeated


def test_peer_without_redundancy_is_not_repaired() -> None:
    """The setting says so."""
    network = Network([Radio(0.01, 0.3)], Link(redundancy=Redundancy.NONE))
    in_use(network, 20.0)
    assert not network.alpha.link.is_repairing


def test_two_lossy_paths_are_repaired_together() -> None:
    """30 % along each leaves 9 %."""
    network = Network([Radio(0.01, 0.3), Radio(0.03, 0.3)])
    in_use(network, 30.0)
    assert network.alpha.link.is_repairing
    assert network.alpha.link.output.repair.transmissions >= 2  # more while one of the paths does not work
    for state in network.alpha.peer.paths.states:
        assert state.loss_out == pytest.approx(0.3, abs=0.2)


def test_peer_that_is_lost_is_repaired_no_more() -> None:
    """What waits would be old when it is back."""
    network = Network([Radio(0.01, 0.3)])
    in_use(network, 20.0)
    network.alpha.link.on_down(network.now)
    assert not network.alpha.link.is_repairing
    assert not network.alpha.link.output.repeats.is_waiting


def test_nothing_is_repeated_while_the_network_is_gone() -> None:
    """What repeats cost does not grow."""
    network = Network([Radio(0.01, 0.3)])
    in_use(network, 20.0)
    end = network.alpha
    end.send(command(1))
    assert end.link.output.repeats.is_waiting
    end.node.set_socket_state(0, network.now, is_up=False)
    state, repeats = end.peer.paths.states[0], end.link.output.repeats
    before = state.repeats, repeats.sent, repeats.bytes_sent
    network.run(network.now + 0.5)
    assert (state.repeats, repeats.sent, repeats.bytes_sent) == before
    assert not repeats.is_waiting
