"""A line with a switch and clients alone: without a core, peers' sockets or a carrier."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

from uavlinkd.daemon.line import Line
from uavlinkd.protocol.timers import Schedule

if TYPE_CHECKING:
    from uavlinkd.daemon.journal import DaemonJournal
    from uavlinkd.daemon.peer_sockets import PeerSockets
    from uavlinkd.daemon.switch import Switch
    from uavlinkd.protocol.node import Node
    from uavlinkd.system.stall import StallWatch


def lone_line(switch: Switch, stall: StallWatch, drops: DaemonJournal) -> Line:
    """A line that forwards between clients."""
    node = cast("Node", SimpleNamespace(schedule=Schedule()))
    sockets = cast("PeerSockets", SimpleNamespace(senders=[]))
    return Line(switch, stall, drops, node, {}, sockets)
