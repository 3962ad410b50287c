"""Answers to ``uavlinkd ping`` and ``uavlinkd netcheck``: how a peer is reached, and how relays see this daemon."""

from __future__ import annotations

from collections.abc import Mapping

from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output
from uavlinkd.link.path_status import NetworkOf, paths_status
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relays import Relays
from uavlinkd.link.status import state_of
from uavlinkd.system.addresses import Address


def ping(
    links: Mapping[str, PeerLink],
    relays: Relays,
    name: str,
    node: Node,
    network_of: NetworkOf,
    now: float,
) -> tuple[dict[str, object], list[Output]]:
    """The paths to a peer, and a question along each of them. The next answer has the results."""
    link = links.get(name)
    if link is None and name in relays.by_name:
        return {"error": f"{name} is a relay, not a peer: `uavlinkd netcheck` and `uavlinkd status` show it"}, []
    if link is None:
        peers = f"write one of {', '.join(links)}" if links else "this daemon has no peers"
        return {"error": f"there is no peer of this name: {peers}"}, []
    states = link.peer.paths.states
    answer: dict[str, object] = {"paths": paths_status(link, network_of, now, relays.handles.address_of)}
    return answer, [output for state in states for output in node.ask(link.peer, state.path, now)]


def views(relays: Relays, sockets: PeerSockets, *, is_relay: bool) -> dict[str, object]:
    """How each relay sees each socket, what the last filter tests showed, and the candidates of this daemon."""
    own, candidates = relays.places()
    network_of = sockets.network_name
    return {
        "relays": {
            name: {
                "state": state_of(relay.peer),
                "round_trip_s": relay.peer.round_trip_s,
                "addresses": [str(written) for written in relay.addresses],
                "unresolved": sorted(sockets.unresolved(relay.name if relay.link is None else relay.link.name)),
            }
            for name, relay in relays.by_name.items()
        },
        "views": [
            {
                "relay": name,
                "relay_address": str(Address.of(path.address)),
                "socket": path.socket,
                "network": network_of(path.socket),
                "seen_as": str(seen),
            }
            for name, relay in relays.by_name.items()
            for path, seen in relay.views()
        ],
        "filtering": [
            {
                "relay": result.relay,
                "relay_address": str(Address.of(result.path.address)),
                "socket": result.path.socket,
                "network": network_of(result.path.socket),
                "other_port_passes": result.passes,
            }
            for result in relays.filter_tests.results
        ],
        "candidates": [str(Address(*place)) for place in candidates],
        "is_relay": is_relay,
        "own": [str(Address(*place)) for place in own],
    }
