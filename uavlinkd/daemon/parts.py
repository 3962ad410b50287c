"""The parts of a daemon, by reference. :mod:`.carrier` moves frames between them, others read them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.members import most_members
from uavlinkd.config.model import Config
from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.line import Line
from uavlinkd.daemon.local_endpoints import LocalEndpoints
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.daemon.switch import Switch
from uavlinkd.io.ports import LocalPort
from uavlinkd.mavlink.payloads import screen
from uavlinkd.mavlink.routing import Router
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import LinkedPeer, Output
from uavlinkd.relay.client_link import RelayLink
from uavlinkd.relay.clients import Relays
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import FaultGuard
from uavlinkd.system.stall import StallWatch

if TYPE_CHECKING:
    from uavlinkd.fleet.members import FleetMembers
    from uavlinkd.relay.service import RelayService


class DaemonParts:
    """What one daemon consists of; it has no peers yet. ``perform`` executes what its relay wants."""

    def __init__(
        self, config: Config, log: FilteringBoundLogger, now: float, perform: Callable[[Iterable[Output]], None]
    ) -> None:
        self.config = config
        """The one in force."""
        self.log = log
        self.started_at = now
        self.node = node = Node(
            config.private_key,
            os.urandom,
            now,
            screen=screen,
            takes_certificates=config.fleet is not None,
            most_admitted=most_members(config),
        )
        self.fleet: FleetMembers | None = None
        """Who is a member by certificate; None without a fleet."""
        self.links: dict[str, PeerLink] = {}
        """By the peer's name."""
        self.link_of: dict[LinkedPeer, PeerLink] = {}
        """By each peer of the core that carries frames."""
        relay_links: dict[str, RelayLink] = {}
        self.journal = journal = DaemonJournal()
        """What those that watch the daemon read."""
        self.guard = FaultGuard(log, journal.on_loop_failure)
        self.evidence = Evidence(self.links, config.public_key, relay_links)
        self.stall = StallWatch(now, journal.on_pause)
        self.peer_sockets = sockets = PeerSockets(self.stall, journal, self.evidence, log, node)
        self.switch = Switch(Router[PeerLink | LocalPort](relays=config.relays_frames), journal)
        self.line = Line(self.switch, self.stall, journal, node, self.link_of, sockets)
        self.local = LocalEndpoints(config.name, self.switch, journal, self.stall)
        self.local.on_frames = self.line.forward
        self.relays = Relays(node, sockets, self.links, relay_links, log)
        """Those that this daemon uses."""
        self.relay: RelayService | None = None
        """That of this daemon, if it is one."""
        if config.relay_server is not None:
            from uavlinkd.relay.service import RelayService, RelayShell  # noqa: PLC0415  only if configured

            shell = RelayShell(
                entropy=os.urandom,
                clock=monotonic,
                perform=perform,
                send=sockets.send,
                on_event=journal.write,
            )
            self.relay = RelayService(node, config.relay_server.limits, shell)
            sockets.pause_s = 0.0
