"""Two daemons that know only relays: a client at the left one, a ground station at the right.

All run in the event loop of the test, on ports that the kernel chooses.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.daemon.udp import Client, open_client
from tests.link.test_calls_per_frame import ANY_PORT, OPERATOR, PUBLIC, VEHICLE, config, endpoint_of
from uavlinkd.config import Config, PeerAddress, RelayConfig, RelayServer
from uavlinkd.config.model import Log, Routing
from uavlinkd.config.used_relays import TIMERS
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.endpoints.url import EndpointKind, NetworkUrl
from uavlinkd.link.daemon import Daemon
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.relay.member_settings import MemberSettings, RelayLimits
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic

_LINK = Link(features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS)
_LIMITS = RelayLimits(100_000, 10**9)
_PRIVATE = {"vps": bytes([21]) * 32, "spare": bytes([22]) * 32}
_NUMERIC = NetworkUrl(EndpointKind.UDPIN, ANY_PORT)


class RelayLine:
    """The two daemons and their relays, which have names."""

    left: Daemon
    right: Daemon
    client: Client
    ground: Client

    def __init__(self, *names: str) -> None:
        self.names = names
        self.relays: dict[str, Daemon] = {}
        self._addresses: dict[str, Address] = {}

    async def start_relay(self, name: str) -> None:
        """Start a relay, at its former port if it had one. It knows nothing of what was before."""
        members = tuple(
            MemberSettings(PeerSettings(member, key, None, _LINK), 8, _LIMITS) for member, key in PUBLIC.items()
        )
        relay = self.relays[name] = Daemon(
            Config(
                path=Path(name),
                name=name,
                private_key=Secret(_PRIVATE[name]),
                public_key=KeyPair(_PRIVATE[name]).public,
                listen=(self._addresses.get(name, ANY_PORT),),
                endpoints=(),
                peers=(),
                routing=Routing(),
                control_socket=None,
                metrics=None,
                recording=None,
                log=Log("info", "json"),
                warnings=(),
                relay_server=RelayServer(members, _LIMITS),
            )
        )
        await relay.start()
        (self._addresses[name],) = relay.peer_sockets.addresses

    async def kill_relay(self, name: str) -> None:
        """It vanishes without closing its sessions."""
        relay = self.relays.pop(name)
        for peer in list(relay.node.peers.values()):
            relay.node.remove_peer(peer, monotonic())
        await relay.stop()

    def relay_config(self, name: str) -> RelayConfig:
        """A relay that was started, as the daemons' configurations have it."""
        link = replace(_LINK, timers=TIMERS)
        settings = PeerSettings(f"relay {name}", KeyPair(_PRIVATE[name]).public, None, link)
        return RelayConfig(settings, (PeerAddress(self._addresses[name]),))

    async def start(self, *, left_uses: tuple[str, ...] | None = None) -> None:
        """Start the relays and both daemons."""
        for name in self.names:
            await self.start_relay(name)
        self.client, self.ground = await open_client(), await open_client()
        to_ground = NetworkUrl(EndpointKind.UDPOUT, Address(*self.ground.address))
        self.right = self._daemon("right", "left", to_ground, VEHICLE, self.names)
        self.left = self._daemon("left", "right", _NUMERIC, OPERATOR, self.names if left_uses is None else left_uses)
        for daemon in (self.right, self.left):
            await daemon.start()

    def _daemon(self, name: str, peer: str, url: NetworkUrl, rules: dict[str, Any], uses: tuple[str, ...]) -> Daemon:
        made = config(name, url, peer, (), rules)
        peers = tuple(replace(one, relays=uses) for one in made.peers)
        return Daemon(replace(made, peers=peers, relays=tuple(map(self.relay_config, self.names))))

    async def stop(self) -> None:
        """Stop everything."""
        for daemon in (self.left, self.right):
            await daemon.stop()
        for name in list(self.relays):
            await self.kill_relay(name)
        self.client.close()
        self.ground.close()
        await asyncio.sleep(0)

    @property
    def links(self) -> tuple[PeerLink, PeerLink]:
        """From left to right, and back."""
        return self.left.links["right"], self.right.links["left"]

    @property
    def is_up(self) -> bool:
        """Whether both ends say so."""
        return all(link.peer.is_up for link in self.links)

    def usable(self, link: PeerLink) -> list[PathState]:
        """The paths of a link that answer."""
        return [state for state in link.peer.paths.states if state.condition is PathCondition.USABLE]

    def send(self, *frames: bytes) -> None:
        """From the client."""
        for frame in frames:
            self.client.send(frame, endpoint_of(self.left).address)
