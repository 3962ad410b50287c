"""The parts of a daemon, by reference. :mod:`.carrier` moves frames between them, others read them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import Config
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.evidence import Evidence, History
from uavlinkd.link.local_endpoints import LocalEndpoints
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.link.relays import Relays
from uavlinkd.link.switch import Switch
from uavlinkd.mavlink.payloads import screen
from uavlinkd.mavlink.routing import Router
from uavlinkd.ops.recorder import Recorder
from uavlinkd.relay.service import RelayService, RelayShell
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch


@dataclass(slots=True, kw_only=True)
class DaemonParts:
    """What one daemon consists of."""

    config: Config
    """The one in force."""
    log: FilteringBoundLogger
    node: Node
    links: dict[str, PeerLink]
    """By the peer's name."""
    link_of: dict[LinkedPeer, PeerLink]
    """By each peer of the core that carries frames: a link has several while keys change."""
    switch: Switch
    peer_sockets: PeerSockets
    relays: Relays
    """Those that this daemon uses."""
    relay: RelayService | None
    """That of this daemon, if it is one."""
    local: LocalEndpoints
    stall: StallWatch
    recorder: Recorder | None
    """From the start on, if the daemon records."""
    drops: DropSummary
    events: EventLog
    evidence: Evidence
    history: History


def make_parts(
    config: Config, log: FilteringBoundLogger, now: float, perform: Callable[[Iterable[Output]], None]
) -> DaemonParts:
    """The parts of a daemon with this configuration, without peers. ``perform`` executes what its relay wants."""
    node = Node(config.private_key, os.urandom, now, config.previous_private_key, screen=screen)
    links: dict[str, PeerLink] = {}
    relay_links: dict[str, RelayLink] = {}
    limits, history = LineLimits(), History(now)
    drops = DropSummary(log, limits)
    evidence = Evidence(links, config.public_key, relay_links)

    def on_pause(pause_s: float) -> None:
        history.paused = monotonic(), pause_s
        events.write_pause(pause_s, monotonic())

    stall = StallWatch(now, on_pause)
    sockets = PeerSockets(stall, drops, evidence, log, node)
    events = EventLog(log, limits, sockets.network_name)
    router = Router[PeerLink | LocalPort](relays=config.routing.relay)
    switch = Switch(router, stall, drops)
    relay: RelayService | None = None
    if config.relay_server is not None:
        shell = RelayShell(
            entropy=os.urandom,
            clock=monotonic,
            perform=perform,
            send=sockets.send,
            send_from_new_port=sockets.send_from_new_port,
            on_event=events.write,
        )
        relay = RelayService(node, config.relay_server.limits, shell)
        sockets.pause_s = 0.0
    return DaemonParts(
        config=config,
        log=log,
        node=node,
        links=links,
        link_of={},
        switch=switch,
        peer_sockets=sockets,
        relays=Relays(node, sockets, links, relay_links, log),
        relay=relay,
        local=LocalEndpoints(config.name, switch, events, stall),
        stall=stall,
        recorder=None,
        drops=drops,
        events=events,
        evidence=evidence,
        history=history,
    )
