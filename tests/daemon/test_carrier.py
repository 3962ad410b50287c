"""From datagrams to frames, and the order of what waits in a busy daemon. The core delivers what a test chooses."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from itertools import islice
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import pytest
from structlog import get_logger

from tests.daemon.test_peer_link import link_of
from tests.policies import TRUSTED
from tests.protocol.harness import AT_A, KEY_A, Pair
from tests.samples import attitude, command, raws
from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon import carrier as module
from uavlinkd.daemon.carrier import FrameCarrier
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.line import Line
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.switch import Switch
from uavlinkd.daemon.turns import (
    SHARED_BYTES,
    STARTS_OF_A_FRAME,
    WAITING_BYTES,
    WAITING_OVERHEAD_BYTES,
    Turns,
    cost_of,
)
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Dropped, Output, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import RELAYED_START, wrap
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.timers import Schedule
from uavlinkd.protocol.wire import ENVELOPE_STARTS
from uavlinkd.relay.clients import Relays
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

ENVELOPE = min(ENVELOPE_STARTS)
HANDSHAKES = [bytes((1, number)) for number in range(5)]
"""Initiations, the oldest first."""
OLD, NEW = attitude(1), attitude(2)
COMMANDS = command(1), command(2)


class Scene:
    """A carrier with a core that delivers one envelope for each datagram, in the order of this list."""

    def __init__(self, envelopes: Sequence[tuple[int, Sequence[Frame]]] = ()) -> None:
        pair = Pair()
        self.link = link_of(pair.b, PeerConfig(PeerSettings("alpha", KEY_A.public), (), TRUSTED), lambda _: None)
        self.peer = pair.b.peer
        self.envelopes = list(envelopes)
        self.delivered: list[bytes] = []
        self.received: list[tuple[bytes, Path]] = []
        self.dropped: list[tuple[str, str, int]] = []
        self.refused: list[Dropped] = []
        self.stall = StallWatch(monotonic(), lambda _: None)
        node = SimpleNamespace(
            receive=self.receive,
            refuse=lambda datagram, path: Dropped(DropReason.OVER_SHARE, None, path),
            claimed_sender=lambda *_: 0,
            screen=lambda *_: None,
            handshake_source=lambda datagram, path, now: (path, datagram[:2]) if datagram[:1] == b"\1" else None,
            initiations_from=lambda path: [(path, HANDSHAKES[4])],
            next_deadline=lambda: NEVER,
            schedule=Schedule(),
            drops=dict.fromkeys(DropReason, 0),
        )
        drops = SimpleNamespace(
            add=lambda event, reason, name, count, *_: self.dropped.append((reason, name, count)),
            add_dropped=lambda dropped, now: self.refused.append(dropped),
            write=lambda *_: None,
        )
        parts = SimpleNamespace(
            node=node,
            stall=self.stall,
            link_of={self.peer: self.link},
            peer_sockets=SimpleNamespace(budgets={}, senders=[]),
            features=[],
            fleet=None,
            config=SimpleNamespace(fleet=None),
            journal=drops,
            evidence=SimpleNamespace(add_dropped=lambda *_: None),
        )
        self.node = node
        line = Line(
            cast("Switch", None),
            self.stall,
            cast("DaemonJournal", drops),
            cast("Node", node),
            parts.link_of,
            parts.peer_sockets,
        )
        line.forward = self.forward  # type: ignore[method-assign,assignment]
        self.line = parts.line = line
        self.carrier = FrameCarrier(cast("DaemonParts", parts))

    def receive(self, datagram: bytes, path: Path, now: float, *, is_screened: bool = False) -> list[Output]:
        """The core's."""
        self.received.append((datagram, path))
        if not self.envelopes:
            return []
        order, frames = self.envelopes.pop(0)
        return [Deliver(self.peer, b"".join(raws(frames)), order)]

    def forward(self, source: PeerLink, frames: Sequence[Frame], now: float, epoch: int) -> None:
        """The switch's."""
        assert source is self.link
        self.delivered += raws(frames)

    def read(self, *datagrams: bytes) -> None:
        """One wake-up."""
        self.line.receive(
            AT_A.socket, [(datagram, AT_A.address) for datagram in datagrams], monotonic(), self.stall.epoch, 0.0
        )


@pytest.mark.parametrize("wake_ups", [(1, 1, 1), (3,), (1, 2)], ids=["alone", "together", "both"])
async def test_state_of_an_older_envelope_is_dropped_and_counted(wake_ups: tuple[int, ...]) -> None:
    """However the datagrams are read: the order of each envelope is kept while they wait for one delivery."""
    scene = Scene([(1, [COMMANDS[0]]), (3, [NEW, COMMANDS[1]]), (2, [OLD, COMMANDS[0]])])
    for count in wake_ups:
        scene.read(*[ENVELOPE] * count)
    assert scene.delivered == raws([COMMANDS[0], NEW, COMMANDS[1], COMMANDS[0]])
    assert scene.dropped == [("superseded", "alpha", 1)]
    assert (scene.link.frames_superseded, scene.link.counters.frames) == (1, 5)


@pytest.mark.parametrize("count", [1, 2], ids=["alone", "together"])
async def test_peer_with_one_path_has_no_order_and_one_without_a_link_no_frames(count: int) -> None:
    """All frames are delivered as they come. A relay carries no frames of its own, whatever a policy says."""
    scene = Scene([(0, [NEW]), (0, [OLD])] * 2)
    for _ in range(2 // count):
        scene.read(*[ENVELOPE] * count)
    assert scene.delivered == raws([NEW, OLD])
    scene.peer = Pair().b.peer
    for _ in range(2 // count):
        scene.read(*[ENVELOPE] * count)
    assert scene.delivered == raws([NEW, OLD])
    assert scene.dropped == [("frames_not_allowed", "alpha", 1)] * 2


async def test_data_along_a_relay_is_unwrapped_or_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core gets the inner datagram with the relayed path; without relays it gets, and drops, all."""
    scene = Scene()
    relays = Relays(cast("Node", scene.node), scene.line, Mock(), {}, {}, get_logger())
    relays.handles.assign("vps", AT_A, [7])
    data = [wrap(7, ENVELOPE + b"rest"), wrap(8, ENVELOPE), RELAYED_START, ENVELOPE]
    scene.read(*data)
    assert scene.received == [(datagram, AT_A) for datagram in data]
    scene.received.clear()
    scene.line.unwrap = relays.unwrap
    unknown: list[Path] = []
    monkeypatch.setattr(relays, "on_unknown_handle", lambda path, _: unknown.append(path))
    scene.read(*data)
    assert unknown == [AT_A]
    assert scene.received == [(ENVELOPE + b"rest", relayed(AT_A.socket, "vps", 7)), (ENVELOPE, AT_A)]
    assert [reason for reason, *_ in scene.dropped] == [
        DropReason.RELAY_UNKNOWN_HANDLE,
        DropReason.RELAY_MALFORMED,
    ]


async def test_fault_costs_one_datagram(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the last one that its sender has waiting: the others have their turns, and so has this sender later."""
    reports: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context["exception"]))
    scene = Scene([(0, [NEW]), (0, [OLD])] * 10)
    receive = scene.receive

    def fail_once(datagram: bytes, path: Path, now: float) -> list[Output]:
        if datagram == ENVELOPE + b"bad" and not reports:
            raise ZeroDivisionError
        return receive(datagram, path, now)

    monkeypatch.setattr(scene.node, "receive", fail_once)
    monkeypatch.setattr(scene.node, "claimed_sender", lambda datagram, _: datagram)
    monkeypatch.setattr(module, "TURN_S", 0.0)
    scene.read(ENVELOPE, *[ENVELOPE + b"bad", ENVELOPE + b"good"] * 2)
    for _ in range(6):
        await asyncio.sleep(0)
    assert len(reports) == 1
    assert [datagram for datagram, _ in scene.received] == [
        ENVELOPE,
        *(ENVELOPE + rest for rest in (b"good", b"bad", b"good")),
    ]
    assert not scene.carrier.waiting(monotonic()), "no sender waits for a turn"


async def test_fault_costs_one_output() -> None:
    """Those behind it are executed, also of other links."""
    reports: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context["exception"]))
    scene = Scene()
    payload = b"".join(raws([NEW]))
    deliver = Deliver(scene.peer, payload)
    scene.carrier.perform([Transmit(b"", AT_A), deliver, Deliver(scene.peer, cast("bytes", None)), deliver])
    assert len(reports) == 2, "there are no senders, and that is no payload"
    assert scene.delivered == raws([NEW]) * 2


async def handled(*datagrams: bytes) -> tuple[list[bytes], int]:
    """In what order a core gets datagrams that were read together, and how many are refused."""
    scene = Scene()
    scene.read(*datagrams)
    for _ in range(2 * len(datagrams)):
        await asyncio.sleep(0)
    return [datagram for datagram, _ in scene.received], len(scene.refused)


async def test_handshakes_do_not_keep_the_first_sessions_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """They come before the envelopes while there is time. Of each source the newest waits, in the place of the first.

    One that is superseded, and the oldest of too many, are dropped and counted.
    """
    assert await handled(ENVELOPE, *HANDSHAKES) == ([*HANDSHAKES, ENVELOPE], 0)
    monkeypatch.setattr(module, "HANDSHAKES_S", 0.0)
    first, *others = HANDSHAKES
    assert await handled(*HANDSHAKES, ENVELOPE) == ([first, ENVELOPE, *others], 0)
    newer = others[0] + b"newer"
    assert await handled(*HANDSHAKES, newer) == ([first, newer, *others[1:]], 1)
    monkeypatch.setattr(module, "WAITING_HANDSHAKES", 2)
    assert await handled(*HANDSHAKES) == ([HANDSHAKES[3], HANDSHAKES[4]], 3)
    garbage = [bytes((3, number)) for number in range(5)]
    assert await handled(*HANDSHAKES[:2], *garbage) == ([*garbage, *HANDSHAKES[:2]], 0), "it pushes out no initiation"


async def test_initiation_of_a_sender_that_has_a_session_now_is_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was repeated before the first answer arrived."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 0.0)
    scene = Scene()
    scene.read(*HANDSHAKES)
    established = SessionEstablished(scene.peer, AT_A, 1, "x25519", False, 16, initiator=False, rekey=False)
    scene.carrier.perform([established])
    for _ in HANDSHAKES:
        await asyncio.sleep(0)
    assert [datagram for datagram, _ in scene.received] == HANDSHAKES[:4]
    assert len(scene.refused) == 1


# Datagrams that wait: senders take turns, and what one may have waiting is bounded.

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
