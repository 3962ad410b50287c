"""What a daemon offers to its fleet: the parts that members concern, and what it does about its peers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output
from uavlinkd.protocol.peer import Peer
from uavlinkd.relay.clients import Relays
from uavlinkd.relay.service import RelayService


class Membership(Protocol):
    """What the daemon does about its peers."""

    def add_member(self, config: PeerConfig, peer: Peer | None) -> None:
        """Carry frames to a member. ``peer``: it is in the core already."""

    def remove_peer(self, name: str, *, closes: bool) -> None:
        """End the link at once. ``closes``: with a close."""

    def change_peer(self, config: PeerConfig) -> None:
        """Apply another policy."""


@dataclass(frozen=True, slots=True)
class FleetShell:
    """The parts of a daemon that its fleet concerns. ``perform`` executes outputs of the core."""

    node: Node
    links: Mapping[str, PeerLink]
    relays: Relays
    relay: RelayService | None
    evidence: Evidence
    membership: Membership
    perform: Callable[[list[Output]], None]
