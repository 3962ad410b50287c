"""What a configuration says about the members of a relay."""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.core.settings import PeerSettings


@dataclass(frozen=True, slots=True)
class RelayLimits:
    """What one member, or all members together, may send through the relay. ``bits_s``: of UDP payload."""

    datagrams_s: int
    bits_s: int


@dataclass(frozen=True, slots=True)
class MemberSettings:
    """A member: who it is, how many members it may ask for, and what it may send."""

    peer: PeerSettings
    most_peers: int
    limits: RelayLimits

    @property
    def name(self) -> str:
        """Its name in the configuration."""
        return self.peer.name
