"""A valid configuration: checked, with inherited values and the content of its key files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from uavlinkd.core.crypto import Secret
from uavlinkd.core.settings import PeerSettings
from uavlinkd.endpoints.url import EndpointUrl
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.policy.compilation import Policy, compile_policy
from uavlinkd.system.addresses import Address

PolicyData = Mapping[str, object]
"""A policy as immutable plain data. :mod:`uavlinkd.mavlink.policy.compilation` documents its keys."""


def _trust_all() -> PolicyData:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class EndpointConfig:
    """A local MAVLink port.

    ``max_age_s``: a frame that waited longer for the port is dropped. ``radio_status``: whether this daemon reports
    the state of the link to the client there, by a RADIO_STATUS every second. ``status_text``: whether it reports
    lost links and withheld commands to the pilot there.
    """

    name: str
    url: EndpointUrl
    policy: PolicyData = field(default_factory=_trust_all)
    max_age_s: float = 1.0
    radio_status: bool = False
    status_text: bool = False

    def make_policy(self) -> Policy:
        """A new policy: its counters at zero, its rates unused."""
        return compile_policy(self.policy, is_local=True)


@dataclass(frozen=True, slots=True)
class PeerConfig:
    """Another daemon: its settings in the core, and its addresses. Without addresses, the peer initiates.

    ``previous_public_key``: its old key, while the key changes.
    """

    settings: PeerSettings
    addresses: tuple[Address, ...]
    policy: PolicyData
    egress: EgressSettings = field(default_factory=EgressSettings)
    previous_public_key: bytes | None = None

    @property
    def name(self) -> str:
        """The name of the peer in this configuration, unique among the peers."""
        return self.settings.name

    def make_policy(self) -> Policy:
        """A new policy: its counters at zero, its rates unused."""
        return compile_policy(self.policy)


@dataclass(frozen=True, slots=True)
class Routing:
    """``relay``: whether frames from a peer may go to other peers.

    ``unknown_targets``: where a frame goes whose target was never seen. ``flood``: to every other port, as a network
    switch does; ``drop``: nowhere.
    """

    relay: bool = False
    unknown_targets: Literal["flood", "drop"] = "flood"


@dataclass(frozen=True, slots=True)
class Recording:
    """Recordings of the frames on the link: the newest ``max_files`` files of up to ``max_file_bytes``.

    ``min_free_bytes``: free space to keep on the disk.
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
    """The complete configuration of a daemon. Its secrets do not print.

    ``listen`` is empty if the daemon only initiates. ``metrics`` is the address of the server for Prometheus.
    ``warnings`` are sentences for a person; the daemon runs in spite of them. Previous keys are valid for
    ``key_grace_s``, or until the new ones are confirmed.
    """

    path: Path
    name: str
    private_key: Secret
    public_key: bytes
    listen: tuple[Address, ...]
    endpoints: tuple[EndpointConfig, ...]
    peers: tuple[PeerConfig, ...]
    routing: Routing
    control_socket: Path | None
    metrics: Address | None
    recording: Recording | None
    log: Log
    warnings: tuple[str, ...]
    previous_private_key: Secret | None = None
    key_grace_s: float = 0.0
