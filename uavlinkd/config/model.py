"""A configuration that was found good: checked, inherited and loaded, with nothing left to look up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from uavlinkd.system.addresses import Address
from uavlinkd.core.crypto import Secret
from uavlinkd.core.settings import PeerSettings
from uavlinkd.endpoints.url import EndpointUrl
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.policy.compilation import Policy, compile_policy

PolicyData = Mapping[str, object]
"""A policy as plain data, which cannot change: :mod:`uavlinkd.mavlink.policy.compilation` says what the keys mean."""


def _trust_all() -> PolicyData:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A local MAVLink port.

    ``max_age_s``: a frame that waited longer for the port to take it is dropped. ``radio_status``: whether this
    daemon tells the program there how the link is, by a RADIO_STATUS a second.
    """

    name: str
    url: EndpointUrl
    policy: PolicyData = field(default_factory=_trust_all)
    max_age_s: float = 1.0
    radio_status: bool = False

    def make_policy(self) -> Policy:
        """A new policy: its counters at zero, its rates unused."""
        return compile_policy(self.policy, is_local=True)


@dataclass(frozen=True, slots=True)
class Peer:
    """Another daemon: what the core needs of it, and where it is called. Without addresses, it calls.

    ``previous_public_key``: what its key was, while it changes.
    """

    settings: PeerSettings
    addresses: tuple[Address, ...]
    policy: PolicyData
    egress: EgressSettings = field(default_factory=EgressSettings)
    previous_public_key: bytes | None = None

    @property
    def name(self) -> str:
        """What the peer is called here; unique among the peers."""
        return self.settings.name

    def make_policy(self) -> Policy:
        """A new policy: its counters at zero, its rates unused."""
        return compile_policy(self.policy)


@dataclass(frozen=True, slots=True)
class Routing:
    """``relay``: whether what comes from a peer may go to other peers.

    ``unknown_targets``: where a frame goes whose target was never heard. ``flood``: to every other port, as a network
    switch does; ``drop``: nowhere.
    """

    relay: bool = False
    unknown_targets: Literal["flood", "drop"] = "flood"


@dataclass(frozen=True, slots=True)
class Recording:
    """Where what crosses the link is kept, in files of up to ``max_file_bytes``, the newest ``max_files`` of them.

    ``min_free_bytes`` of the disk are left to others.
    """

    folder: Path
    max_file_bytes: int
    max_files: int
    min_free_bytes: int


@dataclass(frozen=True, slots=True)
class Log:
    """``level``: debug, info, warning or error. ``format``: console, json, or auto (console on a terminal)."""

    level: str
    format: str


@dataclass(frozen=True, slots=True)
class Config:
    """Everything that a daemon is told. Secrets in it do not print.

    ``listen`` is empty where the daemon only calls. ``metrics`` is where Prometheus is answered. ``warnings`` are
    sentences for a person: nothing in them keeps the daemon from running. Previous keys are good for
    ``key_grace_s``, or until the new ones are confirmed.
    """

    path: Path
    name: str
    private_key: Secret
    public_key: bytes
    listen: tuple[Address, ...]
    endpoints: tuple[Endpoint, ...]
    peers: tuple[Peer, ...]
    routing: Routing
    control_socket: Path | None
    metrics: Address | None
    recording: Recording | None
    log: Log
    warnings: tuple[str, ...]
    previous_private_key: Secret | None = None
    key_grace_s: float = 0.0
