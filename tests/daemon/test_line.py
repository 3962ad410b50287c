"""The line with a real core: what a frame that is sent leaves to the timers."""

from __future__ import annotations

from math import inf
from types import SimpleNamespace
from typing import cast

import pytest

from tests.daemon.test_peer_link import link_of
from tests.daemon.test_switch import Client
from tests.policies import TRUSTED
from tests.protocol.harness import KEY_A, Pair
from tests.samples import attitude
from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.line import Line
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.daemon.switch import Port, Switch
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.routing import Router
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.timers import Timer
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch


@pytest.mark.parametrize("is_last", [False, True], ids=["of a silence", "before new keys"])
def test_what_is_sent_sets_the_timer_of_the_daemon(is_last: bool) -> None:
    """Nothing may come back: a peer that is gone is noticed by the silence after the first frame."""
    pair = Pair().establish()
    side, now = pair.b, 1.0
    link = link_of(side, PeerConfig(PeerSettings("alpha", KEY_A.public), (), TRUSTED), lambda _: None)
    sent: list[bytes] = []
    sockets = SimpleNamespace(senders=[lambda datagram, address: sent.append(datagram)])
    stall, drops = StallWatch(monotonic(), lambda _: None), DaemonJournal()
    switch = Switch(Router[Port](), drops)
    line = Line(switch, stall, drops, side.node, {side.peer: link}, cast("PeerSockets", sockets))
    armed: list[float] = []
    line.timer_at, line.arm = inf, lambda: armed.append(side.node.next_deadline())
    client = Client("client")
    switch.add(client.port, Policy({}, is_local=True))
    switch.add(link, link.policy)
    side.node.schedule.remove(side.peer)  # as if no deadline were near
    if is_last:
        side.peer.sessions.confirmed[0].send_counter = c.REKEY_AFTER_ENVELOPES - 1

    line.forward(client.port, [attitude(1)], now, stall.epoch)
    assert len(sent) == 1
    assert armed
    assert armed[-1] == side.node.next_deadline() <= side.peer.timers.next_at
    assert side.peer.timers.deadlines[Timer.SILENCE] < inf
