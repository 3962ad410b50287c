"""A valid configuration: checked, with inherited values and the content of its key files."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.io.url import EndpointKind, EndpointUrl, SerialUrl
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.settings import read_settings
from uavlinkd.protocol.crypto import AuthorityKey, Secret
from uavlinkd.protocol.path import RELAY_HOST, SERIAL_HOST
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.system.addresses import Address
from uavlinkd.system.terminal import UsageError

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate
    from uavlinkd.relay.forwarding import MemberSettings

LINK_ID: Final = 100
"""A daemon's number in its signatures, by default. Autopilots number their own ports from 0."""
SERIAL = Address(SERIAL_HOST, 0)  # the other end of a serial network
PolicyData = Mapping[str, object]
"""A policy as immutable plain data. :mod:`uavlinkd.mavlink.policy.compilation` documents its keys."""


class Problem(NamedTuple):
    """One problem: its file, its key (empty: the file itself), what is wrong and what to do."""

    file: str
    key: str
    message: str

    def __str__(self) -> str:
        return ": ".join(part for part in self if part)


class ConfigError(UsageError):
    """Every problem of a file. ``str()`` has one line for each."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        super().__init__(problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(map(str, self.problems))


@dataclass(frozen=True, slots=True)
class SigningConfig:
    """MAVLink message signing with the autopilot at an endpoint.

    ``link_id``: the number of this daemon's stream in its signatures, 16 to 255.
    """

    key: Secret
    link_id: int = LINK_ID


@dataclass(frozen=True, slots=True)
class EndpointConfig:
    """A local MAVLink port.

    ``radio_status``: whether this daemon reports the state of the link to the client there, by a RADIO_STATUS every
    second. ``status_text``: whether it reports lost links and withheld commands to the pilot there.
    """

    name: str
    url: EndpointUrl
    policy: PolicyData = field(default_factory=dict)
    radio_status: bool = False
    status_text: bool = False
    signing: SigningConfig | None = None

    @property
    def systems(self) -> frozenset[int]:
        """The systems that its clients may send as, if the file names them."""
        return read_settings(self.policy, is_local=True).systems or frozenset()

    def make_policy(self) -> Policy:
        """A new policy: its counters at zero, its rates unused."""
        return Policy(self.policy, is_local=self.url.kind is not EndpointKind.STATION)


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """An exit of this machine: an interface, an address of this machine, or a serial device. One of them is not None.

    ``metered``: traffic costs money. ``budget_bits_s``: limit for all peers together; 0: no limit. ``air_bits_s``:
    what the radio behind a serial device carries, both directions together. This end's part is ``budget_bits_s``.
    """

    name: str
    interface: str | None = None
    address: str | None = None
    metered: bool = False
    budget_bits_s: int = 0
    serial: SerialUrl | None = None
    air_bits_s: int = 0

    @property
    def exit(self) -> str:
        """The interface, the address or the device, for people."""
        if self.serial is not None:
            return f"serial {self.serial.device} at {self.serial.baud} baud"
        return f"interface {self.interface}" if self.address is None else f"address {self.address}"

    @property
    def families(self) -> tuple[socket.AddressFamily, ...]:
        """The address families that it can have: none on a serial device."""
        if self.serial is not None:
            return ()
        if self.address is None:
            return socket.AF_INET, socket.AF_INET6
        return (socket.AF_INET6 if ":" in self.address else socket.AF_INET,)


@dataclass(frozen=True, slots=True, order=True)
class PeerAddress:
    """An address of a peer. ``network``: the only network to use it on; empty: every network of its family.

    The peer at the other end of a serial network has the address :data:`.SERIAL` there.
    """

    address: Address
    network: str = ""

    @property
    def is_serial(self) -> bool:
        """Whether it is the other end of a serial network, which needs no address."""
        return self.address == SERIAL

    def __str__(self) -> str:
        if self.is_serial:
            return f"serial network {self.network}"
        return f"{self.address} on {self.network}" if self.network else str(self.address)


@dataclass(frozen=True, slots=True)
class PeerConfig:
    """Another daemon: its settings in the core, and its addresses. Without addresses, the peer initiates.

    ``relays``: names of those along which it is reached.
    """

    settings: PeerSettings
    addresses: tuple[PeerAddress, ...]
    policy: PolicyData
    egress: EgressSettings = field(default_factory=EgressSettings)
    relays: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of the peer in this configuration, unique among the peers."""
        return self.settings.name

    @property
    def is_called(self) -> bool:
        """Whether this daemon initiates to it: it has an address, or a relay."""
        return bool(self.addresses or self.relays)

    @property
    def systems(self) -> frozenset[int]:
        """The systems that it may send as: empty if it may send as any."""
        return read_settings(self.policy, is_local=False).systems or frozenset()

    def make_policy(self) -> Policy:
        return Policy(self.policy)


@dataclass(frozen=True, slots=True)
class HttpsServer:
    """Where members reach a relay by TLS."""

    listen: Address
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class RelayServer:
    """This daemon is a relay. ``bits_s``: what all members together may send."""

    members: tuple[MemberSettings, ...]
    bits_s: int
    https: HttpsServer | None = None

    @property
    def by_key(self) -> dict[bytes, MemberSettings]:
        return {member.peer.public_key: member for member in self.members}


@dataclass(frozen=True, slots=True)
class RelayConfig:
    """A relay: its settings in the core, where its name begins with :data:`.RELAY_HOST`, and its addresses.

    ``peer``: the name of the peer with the same key. Then that peer's session serves both, with that peer's settings.
    """

    settings: PeerSettings
    addresses: tuple[PeerAddress, ...]
    peer: str | None = None

    @property
    def name(self) -> str:
        """The name of the relay in this configuration, unique among the relays."""
        return self.settings.name.removeprefix(RELAY_HOST)


@dataclass(frozen=True, slots=True)
class ContactConfig:
    """A member that this daemon knows from the start. ``relays``: whether this daemon uses it as a relay."""

    key: bytes
    certificate: bytes
    name: str
    role: MemberRole
    addresses: tuple[PeerAddress, ...]
    relays: bool


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """The fleet of which this daemon is a member, and what it takes from members that are not in its file.

    ``policies``: what a member of a role may send here; without one it makes no link. ``call``: the roles to which
    this daemon initiates. ``relays``: the names of all relays. ``state_file``: the newest bulletin and certificate.
    ``member_bits_s``: the limit of each member if this daemon is a relay.
    """

    authority: AuthorityKey
    own: HeldCertificate
    bulletin: bytes
    contacts: tuple[ContactConfig, ...]
    call: frozenset[MemberRole]
    required_bulletin: int
    denied: frozenset[str]
    link: Link
    egress: EgressSettings
    policies: Mapping[MemberRole, PolicyData]
    relays: tuple[str, ...]
    state_file: Path
    member_bits_s: int

    def contact(self, key: bytes) -> ContactConfig | None:
        return next((contact for contact in self.contacts if contact.key == key), None)


@dataclass(frozen=True, slots=True)
class StationsConfig:
    """Where stations reach this daemon with WireGuard. Each is an endpoint too.

    ``address``: the daemon's own inside the tunnels. ``state_file``: what must not be forgotten.
    """

    listen: Address
    private_key: Secret
    address: str
    state_file: Path


@dataclass(frozen=True, slots=True)
class Log:
    """``level``: debug, info, warning or error. ``format``: console, json, or auto (console on a terminal)."""

    level: str = "info"
    format: str = "auto"


@dataclass(frozen=True, slots=True)
class Config:
    """The complete configuration of a daemon. Its secrets do not print.

    ``listen`` is empty if the daemon only initiates. ``relays_frames``: whether frames from a peer may go to other
    peers. ``warnings`` are sentences for a person; the daemon runs in spite of them. If ``networks`` has no interface
    or address, the kernel's routes decide how to reach peers over IP.
    """

    path: Path
    name: str
    private_key: Secret
    public_key: bytes
    listen: tuple[Address, ...]
    endpoints: tuple[EndpointConfig, ...]
    peers: tuple[PeerConfig, ...]
    relays_frames: bool
    control_socket: Path | None
    log: Log
    networks: tuple[NetworkConfig, ...] = ()
    relay_server: RelayServer | None = None
    relays: tuple[RelayConfig, ...] = ()
    fleet: FleetConfig | None = None
    stations: StationsConfig | None = None
    signing_state: Path | None = None
    """The file with a timestamp behind those of all signatures; None: it is not kept."""
    warnings: tuple[str, ...] = ()

    @property
    def is_only_relay(self) -> bool:
        """Whether this daemon carries no frames."""
        carries = self.peers or self.endpoints or (self.fleet is not None and self.fleet.policies)
        return self.relay_server is not None and not carries

    def others(self) -> Iterator[tuple[str, PeerSettings, tuple[PeerAddress, ...]]]:
        """The other daemons of the file: the section as a person knows it, the settings and the addresses."""
        for peer in self.peers:
            yield f'peer "{peer.name}"', peer.settings, peer.addresses
        for relay in self.relays:
            if relay.peer is None:
                yield f'relay "{relay.name}"', relay.settings, relay.addresses
        for member in self.relay_server.members if self.relay_server else ():
            yield f'member "{member.name}"', member.peer, ()

    @property
    def keys_of_others(self) -> set[bytes]:
        others: tuple[PeerConfig | RelayConfig, ...] = (*self.peers, *self.relays)
        return {one.settings.public_key for one in others}

    @property
    def has_ip_networks(self) -> bool:
        """Whether networks decide along which sockets of UDP the peers are reached."""
        return any(network.serial is None for network in self.networks)
