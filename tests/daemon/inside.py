"""What tests of other rooms see and set inside the daemon: only this folder names its private attributes."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from typing import cast

from uavlinkd.daemon.daemon import Daemon
from uavlinkd.daemon.switch import Switch
from uavlinkd.relay.client_link import RelayHandles
from uavlinkd.relay.clients import Relays
from uavlinkd.relay.direct_search import OwnSocket


def handle_tables(handles: RelayHandles) -> tuple[Sized, Sized]:
    """The relay handles of what arrives, and those of what is sent."""
    return handles._inward, handles._outward


def set_own_sockets(relays: Relays, own: Sequence[OwnSocket]) -> None:
    """Give the search of direct paths the sockets of this machine, and let it look at the machine no more."""
    relays._looked_at, relays._own = math.inf, list(own)


def most_flows(switch: Switch) -> int:
    """The number of flows that are remembered of the port with the most."""
    return max((len(known.flows) for known in switch.ports.values()), default=0)


async def apply_file(parts: object) -> None:
    """Read the file again, as a daemon that has only these parts."""
    await Daemon._apply_file(cast(Daemon, parts))
