"""The parts of a daemon that findings are made of, without sockets, endpoints and relays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.mavlink.routing import Router
from uavlinkd.protocol.node import Node
from uavlinkd.system.addresses import Address


def parts_of(node: Node, links: Mapping[str, PeerLink], evidence: Evidence, router: Router[Any] | None = None) -> Any:
    """As :class:`uavlinkd.daemon.parts.DaemonParts`; every network is well."""
    sockets = SimpleNamespace(
        unresolved=lambda name: set[str](),
        without_socket=set(),
        absent_addresses=list,
        absent_networks=dict,
        addresses=[Address("0.0.0.0", 5799)],
        networks=SimpleNamespace(networks=[]),
        is_own=lambda address: False,
    )
    config = SimpleNamespace(
        name="drone0",
        path="drone0.toml",
        public_key=node.public_key,
        listen=[Address("0.0.0.0", 5799)],
        endpoints=[],
        relays_frames=False,
    )
    return SimpleNamespace(
        config=config,
        links=links,
        node=node,
        peer_sockets=sockets,
        evidence=evidence,
        journal=DaemonJournal(),
        relay_links={},
        relay=None,
        line=SimpleNamespace(read_at=1.0),
        serial=None,
        tls=None,
        fleet=None,
        guard=SimpleNamespace(faults=Counter(), last_at=0.0),
        local=SimpleNamespace(endpoints=[]),
        switch=SimpleNamespace(router=router or Router[Any]()),
    )
