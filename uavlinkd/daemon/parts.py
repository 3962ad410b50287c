"""The parts of a daemon, by reference. :mod:`.carrier` moves frames between them, others read them.

This is the one module that imports the features, and only those that the configuration file has.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.members import most_members
from uavlinkd.config.model import Config, SigningConfig
from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.features import Feature, PathKind
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
from uavlinkd.protocol.outputs import LinkedPeer
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import FaultGuard
from uavlinkd.system.stall import StallWatch

if TYPE_CHECKING:
    from uavlinkd.daemon.signing import AutopilotSigning
    from uavlinkd.fleet.members import FleetMembers
    from uavlinkd.relay.client_link import RelayLink
    from uavlinkd.relay.clients import Relays
    from uavlinkd.relay.service import RelayService
    from uavlinkd.serial.serial_networks import SerialNetworks
    from uavlinkd.stations.service import Stations
    from uavlinkd.tls.listener import WebListener
    from uavlinkd.tls.relays import WebRelays


class DaemonParts:
    """What one daemon consists of; it has no peers yet."""

    def __init__(self, config: Config, log: FilteringBoundLogger, now: float) -> None:
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
        self.links: dict[str, PeerLink] = {}
        """By the peer's name."""
        self.link_of: dict[LinkedPeer, PeerLink] = {}
        """By each peer of the core that carries frames."""
        self.relay_links: dict[str, RelayLink] = {}
        """The relays that this daemon uses, by name."""
        self.journal = journal = DaemonJournal()
        """What those that watch the daemon read."""
        self.guard = FaultGuard(log, journal.on_loop_failure)
        self.evidence = Evidence(self.links, config.public_key, self.relay_links)
        self.stall = StallWatch(now, journal.on_pause)
        self.peer_sockets = sockets = PeerSockets(self.stall, journal, self.evidence, log, node)
        self.switch = Switch(Router[PeerLink | LocalPort](relays=config.relays_frames), journal)
        self.line = Line(self.switch, self.stall, journal, node, self.link_of, sockets)
        self.local = LocalEndpoints(config.name, self.switch, journal, self.stall)
        self.local.on_frames = self.line.forward
        self.features: list[Feature] = []
        """Those that take part in the daemon's work, in the order in which they learn of an event."""
        self.path_kinds: list[PathKind] = []
        """The kinds of paths beside UDP."""
        self.relay = self._relay_server()
        """That of this daemon, if it is one."""
        self.relays = self._relays()
        """Those that this daemon uses; None if the file has neither relays nor a fleet."""
        self.fleet = self._fleet()
        """Who is a member by certificate; None without a fleet."""
        self.serial = self._serial()
        """The serial networks, if there are any."""
        self.listener = self._listener()
        """Where members reach this relay by TLS."""
        self.tls = self._tls()
        """The connections by TLS to relays."""
        self.stations = self._stations()
        """Who comes with WireGuard."""
        if any(endpoint.signing for endpoint in config.endpoints):
            self.local.sign = self.signing.install

    # Features. Each is imported only if it is configured: a daemon on UDP starts faster and stays smaller.

    def _relay_server(self) -> RelayService | None:
        if (server := self.config.relay_server) is None:
            return None
        from uavlinkd.relay.service import RelayService, RelayShell  # noqa: PLC0415

        line, sockets = self.line, self.peer_sockets
        shell = RelayShell(os.urandom, monotonic, line.perform, sockets.send, self.journal.write)
        service = RelayService(self.node, server.bits_s, shell)
        self.features.append(service)
        line.unwrap, line.on_read = service.forwarding.take, service.on_read
        sockets.pause_s = 0.0
        return service

    def _relays(self) -> Relays | None:
        if not self.config.relays and self.config.fleet is None:
            return None
        from uavlinkd.relay.clients import Relays  # noqa: PLC0415

        line = self.line
        relays = Relays(self.node, line, self.peer_sockets, self.links, self.relay_links, self.log)
        self.features.append(relays)
        if self.config.relays:
            relays.forward = None if self.relay is None else self.relay.forwarding.take
            line.unwrap = relays.unwrap
        return relays

    def _fleet(self) -> FleetMembers | None:
        if (fleet := self.config.fleet) is None:
            return None
        from uavlinkd.fleet.members import FleetMembers  # noqa: PLC0415

        members = FleetMembers(self, fleet)
        self.features.insert(0, members)  # others act on an event of a member that they must know
        return members

    def _serial(self) -> SerialNetworks | None:
        lines = [network for network in self.config.networks if network.serial is not None]
        if not lines:
            return None
        from uavlinkd.serial.serial_networks import SerialNetworks  # noqa: PLC0415

        serial = SerialNetworks(lines, self.node, self.stall, self.log)
        self.path_kinds.append(serial)
        return serial

    def _listener(self) -> WebListener | None:
        if self.config.relay_server is None or (https := self.config.relay_server.https) is None:
            return None
        from uavlinkd.tls.listener import WebListener  # noqa: PLC0415

        listener = WebListener(https, self.node, self.stall, self.journal)
        self.path_kinds.append(listener)
        return listener

    def _stations(self) -> Stations | None:
        if (config := self.config.stations) is None:
            return None
        from uavlinkd.stations.service import Stations  # noqa: PLC0415

        stations = Stations(config, self.stall, self.line)
        self.local.open_station = stations.endpoint
        self.features.append(stations)
        return stations

    @cached_property
    def signing(self) -> AutopilotSigning:
        """The signatures between this daemon and its autopilots: made when an endpoint or a person wants them."""
        from uavlinkd.daemon.signing import AutopilotSigning  # noqa: PLC0415

        signing = AutopilotSigning(self.local, self._keep_signing, self.config.signing_state)
        self.features.append(signing)
        return signing

    def _keep_signing(self, name: str, signing: SigningConfig | None) -> None:
        """The keys of an endpoint have changed, and those in the file too: a reload compares the two."""
        endpoints = self.config.endpoints
        changed = (replace(one, signing=signing) if one.name == name else one for one in endpoints)
        self.config = replace(self.config, endpoints=tuple(changed))

    def _tls(self) -> WebRelays | None:
        if not any(written.address.resource for relay in self.config.relays for written in relay.addresses):
            return None
        from uavlinkd.tls.relays import WebRelays  # noqa: PLC0415

        tls = WebRelays(self.node, self.stall, self.log)
        self.path_kinds.append(tls)
        return tls
