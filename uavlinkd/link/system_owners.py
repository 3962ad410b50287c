"""Which peer or endpoint has a MAVLink system id: by the file, or because its frames were received."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Protocol

from uavlinkd.link.local_endpoints import LocalEndpoints
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.switch import Switch


class Switching(Protocol):
    """The parts of a daemon that know about its ports."""

    links: dict[str, PeerLink]
    local: LocalEndpoints
    switch: Switch


class SystemOwners:
    """Make one for all findings of a moment: the owners are looked up once, when the first is asked for."""

    def __init__(self, daemon: Switching) -> None:
        self._daemon = daemon

    def other_than(self, link: PeerLink, system: int) -> str | None:
        """Another peer, or an endpoint here, that has this system id."""
        return next((name for owner, name in self._owners.get(system, ()) if owner is not link), None)

    @cached_property
    def _owners(self) -> Mapping[int, list[tuple[PeerLink | None, str]]]:
        owners: dict[int, list[tuple[PeerLink | None, str]]] = {}
        for system, link, name in (*self._configured(), *self._received()):
            owners.setdefault(system, []).append((link, name))
        return owners

    def _configured(self) -> Iterator[tuple[int, PeerLink | None, str]]:
        for link in self._daemon.links.values():
            for system in link.policy.incoming.systems or ():
                yield system, link, link.name

    def _received(self) -> Iterator[tuple[int, PeerLink | None, str]]:
        router = self._daemon.switch.router
        for endpoint in self._daemon.local.endpoints:
            for port in endpoint.ports:
                for system in {system for system, _ in router.addresses(port)}:
                    yield system, None, f"endpoint {endpoint.name}"
        for link in self._daemon.links.values():
            for system in {system for system, _ in router.addresses(link)}:
                yield system, link, link.name
