"""A line with a switch and clients alone: without a core, peers' sockets or a carrier."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

from uavlinkd.core.timers import Schedule
from uavlinkd.link.line import Line

if TYPE_CHECKING:
    from uavlinkd.core.node import Node
    from uavlinkd.link.journal import DaemonJournal
    from uavlinkd.link.peer_sockets import PeerSockets
    from uavlinkd.link.switch import Switch
    from uavlinkd.system.stall import StallWatch


def lone_line(switch: Switch, stall: StallWatch, drops: DaemonJournal) -> Line:
    """A line that forwards between clients."""
    node = cast("Node", SimpleNamespace(schedule=Schedule()))
    return Line(switch, stall, drops, node, {}, cast("PeerSockets", None))
