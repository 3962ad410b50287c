"""Addresses and paths for people."""

from __future__ import annotations

from uavlinkd.core.path import RELAY_HOST, SocketAddress
from uavlinkd.system.addresses import Address


def relay_name(address: SocketAddress) -> str | None:
    """The relay through which an address of a path leads; None if it is direct."""
    host = address[0]
    return host.removeprefix(RELAY_HOST) if host.startswith(RELAY_HOST) else None


def shown(address: SocketAddress) -> str:
    """An address as text. That of a relayed path has no handle, which means nothing to a person."""
    relay = relay_name(address)
    return str(Address.of(address)) if relay is None else f"relayed via {relay}"
