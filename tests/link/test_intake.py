"""From datagrams to frames: what the core delivers of a peer with several paths, state by state."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import pytest

from tests.core.harness import AT_A, KEY_A, Pair
from tests.link.test_peer_link import link_of
from tests.mavlink.egress.samples import attitude, command, raws
from tests.policies import TRUSTED
from uavlinkd.config import PeerConfig
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output
from uavlinkd.core.path import Path, SocketAddress, relayed
from uavlinkd.core.relay_records import wrap
from uavlinkd.core.settings import PeerSettings
from uavlinkd.core.wire import ENVELOPE_STARTS
from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.link.intake import Intake
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.relay_handles import RELAYED_START, RelayHandles
from uavlinkd.link.switch import Switch
from uavlinkd.link.turns import WaitingDatagram
from uavlinkd.mavlink.frames import Frame
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

DATAGRAM = min(ENVELOPE_STARTS)
OLD, NEW = attitude(1), attitude(2)
COMMANDS = command(1), command(2)


class Scene:
    """An intake with a core that delivers one envelope for each datagram, in the order of this list."""

    def __init__(self, envelopes: Sequence[tuple[int, Sequence[Frame]]]) -> None:
        pair = Pair()
        self.link = link_of(pair.b, PeerConfig(PeerSettings("alpha", KEY_A.public), (), TRUSTED), lambda _: None)
        self.peer = pair.b.peer
        self.envelopes = list(envelopes)
        self.delivered: list[bytes] = []
        self.superseded = 0
        self.received: list[tuple[bytes, Path]] = []
        self.dropped: list[tuple[DropReason, str]] = []
        self.intake = Intake(
            cast("Node", SimpleNamespace(receive=self.receive, claimed_sender=lambda *_: 0)),
            StallWatch(monotonic(), lambda _: None),
            cast("Switch", SimpleNamespace(forward=self.forward)),
            {self.peer: self.link},
            self.perform,
            lambda link, frames, now, epoch: self.forward(link, frames, now),
            lambda: None,
            self.on_superseded,
            lambda reason, name: self.dropped.append((reason, name)),
        )

    def receive(self, datagram: bytes, path: Path, now: float) -> list[Output]:
        """The core's."""
        self.received.append((datagram, path))
        order, frames = self.envelopes.pop(0)
        return [Deliver(self.peer, b"".join(raws(frames)), order)]

    def perform(self, outputs: list[Output]) -> None:
        """The daemon's."""
        for output in outputs:
            assert isinstance(output, Deliver)
            self.intake.add(output)

    def forward(self, source: PeerLink | LocalPort, frames: Sequence[Frame], now: float) -> None:
        """The switch's."""
        assert source is self.link
        self.delivered += raws(frames)

    def on_superseded(self, link: PeerLink, count: int) -> None:
        """The daemon's."""
        assert link is self.link
        self.superseded += count

    def read(self, *counts: int) -> None:
        """Wake-ups with so many datagrams each."""
        for count in counts:
            now = monotonic()
            self.intake.receive(AT_A.socket, [(DATAGRAM, AT_A.address)] * count, now, 0, 0.0)


@pytest.mark.parametrize("wake_ups", [(1, 1, 1), (3,), (1, 2)], ids=["alone", "together", "both"])
async def test_state_of_an_older_envelope_is_dropped_and_counted(wake_ups: tuple[int, ...]) -> None:
    """However the datagrams are read: the order of each envelope is kept while they wait for one delivery."""
    scene = Scene([(1, [COMMANDS[0]]), (3, [NEW, COMMANDS[1]]), (2, [OLD, COMMANDS[0]])])
    scene.read(*wake_ups)
    assert scene.delivered == raws([COMMANDS[0], NEW, COMMANDS[1], COMMANDS[0]])
    assert scene.superseded == scene.link.frames_superseded == 1
    assert scene.link.counters.frames == 5


@pytest.mark.parametrize("wake_ups", [(1, 1), (2,)], ids=["alone", "together"])
async def test_peer_with_one_path_has_no_order(wake_ups: tuple[int, ...]) -> None:
    """All its frames are delivered as they come."""
    scene = Scene([(0, [NEW]), (0, [OLD])])
    scene.read(*wake_ups)
    assert scene.delivered == raws([NEW, OLD])
    assert scene.superseded == 0


async def test_previous_key_of_a_peer_has_orders_of_its_own() -> None:
    """The orders of two pairs of keys cannot be compared."""
    scene = Scene([(10**9, [NEW])])
    scene.read(1)
    other = Pair().b.peer
    assert scene.link.pick_newest(other, [OLD], 1, monotonic()) == [OLD]
    assert scene.link.pick_newest(scene.peer, [OLD], 1, monotonic()) == []


@pytest.mark.parametrize("wake_ups", [(1, 1), (2,)], ids=["alone", "together"])
async def test_frames_of_a_peer_without_a_link_are_dropped_and_counted(wake_ups: tuple[int, ...]) -> None:
    """A relay carries no frames of its own, whatever a policy says."""
    scene = Scene([(0, [NEW]), (0, [OLD])])
    scene.peer = Pair().b.peer
    scene.read(*wake_ups)
    assert scene.delivered == []
    assert scene.dropped == [(DropReason.FRAMES_NOT_ALLOWED, "alpha")] * 2


async def test_data_along_a_relay_is_unwrapped_or_taken() -> None:
    """The core gets the inner datagram with the relayed path; what the hook keeps for itself goes nowhere else."""
    scene = Scene([(0, [NEW]), (0, [OLD])])
    table = RelayHandles()
    table.assign("vps", AT_A, [7])
    reasons: list[DropReason] = []

    def take(socket: int, data: bytes, source: SocketAddress) -> WaitingDatagram | None:
        taken = table.unwrap(socket, data, source)
        if isinstance(taken, DropReason):
            reasons.append(taken)
            return None
        return taken

    scene.intake.takers[RELAYED_START] = take
    data = [wrap(7, DATAGRAM + b"rest"), wrap(8, DATAGRAM), wrap(7, b"\x50"), DATAGRAM]
    scene.intake.receive(AT_A.socket, [(datagram, AT_A.address) for datagram in data], monotonic(), 0, 0.0)
    assert reasons == [DropReason.RELAY_UNKNOWN_HANDLE, DropReason.RELAY_MALFORMED]
    assert scene.received == [
        (DATAGRAM + b"rest", relayed(AT_A.socket, "vps", 7)),
        (DATAGRAM, AT_A),
    ]
