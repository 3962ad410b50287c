"""The flows that the switch remembers are never older than the rules and the routes."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.lone_line import lone_line
from tests.mavlink.inside import remembered_frames
from tests.mavlink.policy.smuggling import SET_MODE, v1, v2
from uavlinkd.daemon import line as line_module
from uavlinkd.daemon import switch as switch_module
from uavlinkd.daemon.journal import DaemonJournal, ShellReason
from uavlinkd.daemon.pacer import Pacer
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.switch import Switch
from uavlinkd.io.ports import Endpoint, LocalPort, PortHandler
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_datagram
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.routing import Router, Unrouted
from uavlinkd.mavlink.vehicles import Vehicles
from uavlinkd.protocol.peer import Peer as CorePeer
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALL_S, StallWatch


class ClientPort(LocalPort):
    """Keeps the frames that it receives."""

    endpoint: Client

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        self.endpoint.received += [raw for raw, _ in frames]


class Client(Endpoint):
    """An endpoint with one client, which keeps the frames that it receives."""

    def __init__(self, name: str, kind: type[ClientPort] = ClientPort) -> None:
        super().__init__(name, cast(PortHandler, SimpleNamespace(on_frames=None)))
        self.received: list[bytes] = []
        self.port = kind(self, name, None)

    @property
    def ports(self) -> Sequence[LocalPort]:
        return [self.port]

    def start(self) -> None:
        """Nothing to start."""

    def do_housekeeping(self, now: float) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to close."""


class Peer(PeerLink):
    """Keeps the frames that it receives."""

    def __init__(self) -> None:
        self.name = "peer"
        self.received: list[bytes] = []
        self.vehicles = Vehicles()
        self.peer = cast("CorePeer", SimpleNamespace(paths=SimpleNamespace(is_multiple=True)))
        self.pacer = cast("Pacer", SimpleNamespace(is_plain=False))

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        self.received += [raw for raw, _ in frames]


class Stage:
    """Three clients at one switch, where everything passes at first."""

    def __init__(self) -> None:
        self.refused: list[tuple[str, Refusal]] = []
        self.router = Router[switch_module.Port]()
        self.withheld: list[tuple[str, Refusal]] = []
        self.stall = StallWatch(monotonic(), lambda _: None)
        drops = cast("DaemonJournal", SimpleNamespace(add_refused=self.refuse, add=self.drop))
        self.switch = Switch(self.router, drops)
        self.line = lone_line(self.switch, self.stall, drops)
        self.stale = 0
        self.a, self.b, self.c = (Client(name) for name in "abc")
        for client in (self.a, self.b, self.c):
            self.switch.add(client.port, policy())

    def refuse(self, name: str, header: Header, refusal: Refusal, now: float, *, to_them: bool) -> None:
        """Keep it, by its direction."""
        (self.withheld if to_them else self.refused).append((name, refusal))

    def drop(self, event: str, reason: ShellReason, name: str, count: int, now: float) -> None:
        """Count frames from before a pause."""
        assert (event, reason) == ("frames_dropped", ShellReason.STALE)
        self.stale += count

    def forward(self, source: LocalPort, frames: Sequence[Frame], now: float) -> None:
        """Frames that were read just now."""
        self.line.forward(source, frames, now, self.stall.turn(monotonic()))

    def delivered(self) -> tuple[int, int, int]:
        """How many frames each client received since the last call."""
        counts = len(self.a.received), len(self.b.received), len(self.c.received)
        for client in (self.a, self.b, self.c):
            client.received.clear()
        return counts


def policy(**data: object) -> Policy:
    """As a configuration describes it; nothing: everything passes."""
    return Policy(data, is_local=True)


def attitude(number: int, system: int = 1) -> Frame:
    """Different for each number."""
    return made(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1), system)


def request(number: int, target: int) -> Frame:
    """A message to one system, from system 1."""
    return made(mavlink.MAVLink_param_request_read_message(target, 1, b"A", number), 1)


def made(message: mavlink.MAVLink_message, system: int) -> Frame:
    """The frame of a message."""
    (frame,) = split_datagram(message.pack(mavlink.MAVLink(None, system, 1)), SplitCounters())
    return frame


@pytest.fixture
def stage() -> Stage:
    """A new one for each test."""
    return Stage()


def test_each_frame_of_a_message_goes_to_the_same_ports_once(stage: Stage) -> None:
    """Remembered or not: to all others, once. A frame that another port sent already is dropped."""
    for number in range(3):
        stage.forward(stage.a.port, [attitude(number)], 0.1 * number)
        assert stage.delivered() == (0, 1, 1)
    stage.forward(stage.b.port, [attitude(9, system=2)], 0.4)
    assert stage.delivered() == (1, 0, 1)
    stage.forward(stage.b.port, [attitude(2)], 0.5)  # a's, by another route
    assert stage.delivered() == (0, 0, 0)
    assert stage.router.unrouted == {Unrouted.DUPLICATE: 1}


def test_copies_are_looked_for_where_a_frame_can_arrive_again(stage: Stage) -> None:
    """Not while one port alone may send as a system, and peers alone get its frames. Else from the next frame on."""
    peer = Peer()
    stage.switch.remove(stage.b.port)
    stage.switch.remove(stage.c.port)
    stage.switch.add(peer, policy(system_ids=[2]))
    for number in range(3):
        stage.forward(stage.a.port, [attitude(number)], 0.1)
    assert len(peer.received) == 3
    assert remembered_frames(stage.router) == 1, "the first frame of the flow"
    stage.switch.set_policy(peer, policy(system_ids=[1, 2]))
    for number in range(3, 6):
        stage.forward(stage.a.port, [attitude(number)], 0.2)
        stage.line.forward(peer, [attitude(number)], 0.2, stage.stall.epoch)
    assert (len(peer.received), stage.delivered()) == (6, (0, 0, 0))
    assert stage.router.unrouted == {Unrouted.DUPLICATE: 3}
    stage.switch.add(stage.b.port, policy(system_ids=[3]))
    stage.switch.set_policy(peer, policy(system_ids=[2]))
    stage.forward(stage.a.port, [attitude(6), attitude(7), attitude(7)], 0.3)
    assert (len(peer.received), stage.delivered()) == (8, (0, 2, 0)), "it returned from the other client"


def test_a_new_rule_holds_for_the_next_frame(stage: Stage) -> None:
    """For incoming and outgoing frames, and also when the rule is removed again."""
    number = 0

    def delivered() -> tuple[int, int, int]:
        nonlocal number
        number += 1
        stage.forward(stage.a.port, [attitude(number)], 0.01 * number)
        return stage.delivered()

    assert delivered() == (0, 1, 1)
    stage.switch.set_policy(stage.b.port, policy(rate_out={"ATTITUDE": 0}))
    assert (delivered(), delivered()) == ((0, 0, 1), (0, 0, 1))
    assert stage.withheld == [("b", Refusal.RATE_LIMITED)] * 2
    stage.switch.set_policy(stage.b.port, policy())
    assert delivered() == (0, 1, 1)
    stage.switch.set_policy(stage.a.port, policy(system_ids=[7]))
    assert (delivered(), delivered()) == ((0, 0, 0), (0, 0, 0))
    assert stage.refused == [("a", Refusal.FOREIGN_SYSTEM)] * 2
    assert len(stage.withheld) == 2


def test_rule_that_depends_on_the_frame_is_checked_for_each_frame(stage: Stage) -> None:
    """A rate limit counts frames, however often the same message came before."""
    stage.switch.set_policy(stage.c.port, policy(rate_out={"ATTITUDE": 4}))
    stage.forward(stage.a.port, [attitude(number) for number in range(10)], 0.0)
    assert stage.delivered() == (0, 10, 2)
    assert (stage.withheld, stage.refused) == ([("c", Refusal.RATE_LIMITED)] * 8, [])


def test_each_heartbeat_of_a_peer_is_kept_for_the_status(stage: Stage) -> None:
    """The first of a flow and later ones, also without a client; one that the policy refuses is not."""
    peer = Peer()
    stage.switch.add(peer, policy(system_ids=[2]))
    for mode in range(4):
        if mode == 3:
            for client in (stage.a, stage.b, stage.c):
                stage.switch.remove(client.port)
        for system in (2, 3):
            heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, mode, 4, 3)
            stage.line.forward(peer, [made(heartbeat, system)], float(mode), stage.stall.epoch)
        assert [(one["system"], one["custom_mode"]) for one in peer.vehicles.status(float(mode))] == [(2, mode)]
    assert stage.delivered() == (3, 3, 3)


def test_system_that_a_port_may_no_longer_send_as_is_not_looked_for_there(stage: Stage) -> None:
    """A reload takes a system from a peer: the peer gets no more copies of frames for that system."""
    stage.forward(stage.b.port, [attitude(1, system=2), attitude(2, system=3)], 0.0)
    stage.forward(stage.c.port, [attitude(3, system=2)], 0.0)
    stage.delivered()
    stage.switch.set_policy(stage.b.port, policy(system_ids=[3]))
    stage.forward(stage.a.port, [request(1, target=2)], 0.1)
    assert stage.delivered() == (0, 0, 1)
    stage.forward(stage.a.port, [request(2, target=3)], 0.2)
    assert stage.delivered() == (0, 1, 0)


def test_frames_of_a_station_go_to_vehicles_alone(stage: Stage) -> None:
    """Not to another station, nor to an operator's daemon, which would refuse them as those of a foreign system."""
    stage.a.is_station = True
    operator = Peer()
    stage.switch.add(operator, policy(role="operator", system_ids=[255]))
    stage.switch.set_policy(stage.b.port, policy(role="operator", system_ids=[254]))
    stage.forward(stage.a.port, [made(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 253)], 0.1)
    assert stage.delivered() == (0, 0, 1)
    assert operator.received == []


def test_switch_notices_clients_that_come_and_go(stage: Stage) -> None:
    """A client that left receives no more frames, a new one receives the next frame."""
    stage.forward(stage.a.port, [attitude(1)], 0.0)
    stage.switch.remove(stage.b.port)
    stage.forward(stage.a.port, [attitude(2)], 0.1)
    assert stage.delivered() == (0, 1, 2)
    stage.switch.add(stage.b.port, policy())
    stage.forward(stage.a.port, [attitude(3)], 0.2)
    assert stage.delivered() == (0, 1, 1)


def test_memory_is_bounded(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of invented senders are forwarded, and fill no memory."""
    monkeypatch.setattr(switch_module, "MAX_FLOWS", 16)
    for system in range(1, 200):
        stage.forward(stage.a.port, [attitude(1, system)], 0.0)
        assert len(stage.switch.ports[stage.a.port].flows) <= 16
    assert stage.delivered() == (0, 199, 199)


class StreamPort(ClientPort):
    """Keeps what a real endpoint would send."""

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        self.endpoint.received += [frame.raw for frame in frames if self.delivered.admit(frame, source, now)]


def test_refused_frame_does_not_make_the_same_frame_of_another_port_a_duplicate() -> None:
    """A frame that hides a command comes from an operator that may not send it, then from one that may."""
    scene = Stage()
    scene.switch.remove(scene.a.port)
    scene.a = Client("a", StreamPort)
    scene.switch.add(scene.a.port, policy())
    scene.switch.set_policy(scene.b.port, policy(role="operator", system_ids=[255], rate_in={"SET_MODE": 0}))
    (hiding,) = split_datagram(v2(4, bytes(14) + v1(SET_MODE, bytes(5) + b"\x51", 255), 255), SplitCounters())
    scene.forward(scene.b.port, [hiding], 1.0)
    assert (scene.refused, scene.a.received) == ([("b", Refusal.HIDDEN_FRAME)], [])
    scene.forward(scene.c.port, [hiding], 1.1)
    assert scene.a.received == [hiding.raw]


def test_frames_from_before_a_pause_are_dropped_and_counted(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the process pauses after it has read them. Those that come later pass."""
    read_in = stage.stall.turn(monotonic())
    paused = monotonic() + 2 * STALL_S
    monkeypatch.setattr(line_module, "monotonic", lambda: paused)
    stage.line.forward(stage.a.port, [attitude(1), attitude(2)], paused, read_in)
    assert (stage.delivered(), stage.stale, stage.stall.dropped) == ((0, 0, 0), 2, {"a": 2})
    stage.line.forward(stage.a.port, [attitude(3)], paused, read_in + 1)
    assert stage.delivered() == (0, 1, 1)
