"""The keys of a configuration file, with their ranges and defaults: one class for each section.

The kinds of values are in :mod:`uavlinkd.config.values`, checks of several values in :mod:`uavlinkd.config.checks`.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from uavlinkd.config.values import (
    LEAST_BUDGET,
    Budget,
    FileName,
    Interface,
    ListenAddress,
    Name,
    OwnAddress,
    PeerAddresses,
    PublicKey,
    SerialLine,
    Suites,
    Url,
)
from uavlinkd.core import constants as c
from uavlinkd.core.suites import X25519
from uavlinkd.mavlink.egress.budgeted import EgressSettings

_LEAST_AIR = 1000
_EGRESS = EgressSettings()


def _seconds(default: float, least: float, most: float) -> Any:
    return Field(default=default, ge=least, le=most, allow_inf_nan=False)


class Section(BaseModel):
    """Unknown keys are refused, nothing is converted, and no message repeats what was written."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, hide_input_in_errors=True)

    @field_validator("*")
    @classmethod
    def _keep(cls, value: Any, info: ValidationInfo) -> Any:
        """Put each valid value of the file into the context, if there is one.

        The checks of several values use it while other values are invalid, so one run reports every problem.
        """
        if info.context is not None:
            info.context[info.field_name] = value
        return value


class LinkSection(Section):
    """``[link]``, and the same keys in ``[[peer]]``: how to communicate with peers."""

    suites: Suites = Field(default=[X25519], examples=['["x25519"]'])
    """Accepted suites. The first is offered."""
    confidential: bool = False
    """Whether frames are encrypted too. Both ends use the stronger of the two settings."""
    tag_bits: Literal[64, 96, 128, 256] = 128
    """Length of an envelope's HMAC tag. Confidential links always have a tag of 128 bits."""
    mac_key_bits: Literal[256, 512, 1024, 2048] = 256
    max_envelope_bytes: int = Field(
        default=c.DEFAULT_ENVELOPE_LIMIT, ge=c.MIN_ENVELOPE_LIMIT, le=c.MAX_ENVELOPE_LIMIT
    )
    """Largest datagram that carries frames. The default passes every IPv6 path (MTU 1,280 less 48 for IPv6 and
    UDP). The minimum holds the largest MAVLink frame; the maximum fits a UDP datagram. Above the path's MTU less 48
    (28 for IPv4) the network splits datagrams, and losing one part loses all."""

    keepalive_s: float = _seconds(c.KEEPALIVE_S, 0.1, 3600)
    lost_after_s: float = _seconds(c.LOST_AFTER_S, 0.2, 1200)
    """The daemon asks for an echo after a sixth of it, and tries a handshake after a third."""
    retry_max_s: float = _seconds(c.RETRY_MAX_S, 0.05, 60)
    rekey_after_s: float = _seconds(c.REKEY_AFTER_S, 1, 3600)
    reject_after_s: float = _seconds(c.REJECT_AFTER_S, 1, 7200)
    probe_interval_s: float = _seconds(c.PROBE_INTERVAL_S, 0.1, 3600)

    budget_bits_s: Budget = Field(default=_EGRESS.budget_bits_s, ge=0, le=10**9)
    """Most bits per second to the peer, including the headers of IP and UDP. 0: no limit."""
    coalesce_s: float = _seconds(_EGRESS.coalesce_s, 0, 0.5)
    """How long a frame may wait for others to share its envelope. 0: it shares only with frames that already wait."""
    max_age_s: float = _seconds(_EGRESS.max_age_s, 0.1, 60)
    """A frame that waited longer for its turn is dropped as stale."""
    redundancy: Literal["critical", "all", "none"] = "critical"
    """Which classes of frames are sent along every proven path."""
    idle_probe_s: float = _seconds(c.PROBE_IDLE_S, 0, 3600)
    """Interval of the probes along a metered path that is not needed, and while no frames are sent. 0: none."""


class NetworkSection(Section):
    """``[[network]]``: an exit of this machine to the peers."""

    name: Name = Field(examples=['"lte"'])
    interface: Interface | None = Field(default=None, examples=['"wwan0"'])
    """The sockets are bound to this interface."""
    address: OwnAddress | None = Field(default=None, examples=['"10.0.0.5"'])
    """The socket is bound to this address of the machine. The kernel's routes decide the interface."""
    serial: SerialLine | None = Field(default=None, examples=['"/dev/ttyUSB0:57600"'])
    """A serial device with its baud rate: a radio modem, with one peer at the other end."""
    air_bits_s: int | None = Field(default=None, ge=_LEAST_AIR, le=10_000_000, examples=["24000"])
    """What the radio behind the device carries, in both directions together. This end sends 40 % of it."""
    metered: bool = False
    """Whether its traffic costs money."""
    budget_bits_s: Budget = Field(default=0, ge=0, le=10**9)
    """Most bits per second of all peers together, including the headers of IP and UDP. 0: no limit."""


class PolicySection(Section):
    """The keys in ``[[peer]]`` and ``[[endpoint]]`` that limit messages.

    :func:`uavlinkd.mavlink.policy.settings.read_settings` checks them together.
    """

    role: Any = None
    system_ids: Any = None
    allow_in: Any = None
    deny_in: Any = None
    allow_out: Any = None
    deny_out: Any = None
    rate_in: Any = None
    rate_out: Any = None
    mavlink1: Any = None
    ground_station: Any = None


class PeerSection(LinkSection, PolicySection):
    """``[[peer]]``: another daemon."""

    name: Name = Field(examples=['"drone1"'])
    public_key: PublicKey = Field(examples=['"…", what `uavlinkd pubkey` prints on the peer'])
    addresses: PeerAddresses = Field(default=[], examples=['["10.13.0.2:5790"]'])
    """Where this daemon reaches it. Empty: the peer initiates."""
    psk_file: FileName | None = Field(default=None, examples=['"drone0-drone1.psk"'])
    previous_public_key: PublicKey | None = Field(default=None, examples=['"…", what its public key was'])
    """Also accepted while the peer's key changes, until the first session with the new key, or for a week."""
    relays: list[Name] | None = Field(default=None, examples=["[]"])
    """The relays along which to reach it, by name. By default all of the file."""


class RelaySection(Section):
    """``[[relay]]``: a host that passes datagrams between this daemon and its peers, and cannot forge them."""

    name: Name = Field(examples=['"vps"'])
    public_key: PublicKey = Field(examples=['"…", what `uavlinkd pubkey` prints on the relay'])
    addresses: PeerAddresses = Field(default=[], examples=['["relay.example.org:5790"]'])
    """Where this daemon reaches it."""
    psk_file: FileName | None = Field(default=None, examples=['"drone0-vps.psk"'])
    previous_public_key: PublicKey | None = Field(default=None, examples=['"…", what its public key was'])
    """Also accepted while the relay's key changes, until the first session with the new key."""


class MemberSection(Section):
    """``[[member]]``: a daemon that may use this relay."""

    name: Name = Field(examples=['"drone1"'])
    public_key: PublicKey = Field(examples=['"…", what `uavlinkd pubkey` prints on the member'])
    psk_file: FileName | None = Field(default=None, examples=['"vps-drone1.psk"'])
    previous_public_key: PublicKey | None = Field(default=None, examples=['"…", what its public key was'])
    """Also accepted while the member's key changes."""
    max_peers: int = Field(default=256, ge=1, le=4000)
    """Members that it may ask for."""
    datagrams_s: int = Field(default=2000, ge=1, le=10**6)
    """Most datagrams per second from it."""
    bits_s: int = Field(default=20_000_000, ge=LEAST_BUDGET, le=10**10, examples=["20_000_000"])
    """Most bits per second from it, without the headers of IP and UDP."""


class RelayServerSection(Section):
    """``[relay_server]``: what a relay carries for all members together."""

    datagrams_s: int = Field(default=10**6, ge=1, le=10**6, examples=["100_000"])
    bits_s: int = Field(default=10**10, ge=LEAST_BUDGET, le=10**10, examples=["100_000_000"])


class EndpointSection(PolicySection):
    """``[[endpoint]]``: a local MAVLink port."""

    name: Name = Field(examples=['"autopilot"'])
    url: Url = Field(examples=['"udpin:127.0.0.1:14550"'])
    radio_status: bool = False
    """Whether this endpoint gets a RADIO_STATUS every second, from the link's own loss and round-trip figures."""
    status_text: bool = False
    """Whether this endpoint gets a STATUSTEXT when a link is lost or restored, or a command is withheld."""


class RoutingSection(Section):
    """``[routing]``."""

    relay: bool = False
    """Whether frames from a peer may go to other peers."""


class MetricsSection(Section):
    """``[metrics]``."""

    listen: ListenAddress | None = Field(default=None, examples=['"127.0.0.1:9790"'])
    """Where the daemon serves metrics to Prometheus, over HTTP. Off by default."""


class RecordingSection(Section):
    """``[recording]``."""

    folder: FileName | None = Field(default=None, examples=['"recordings"'])
    """Folder for telemetry logs of the frames on the link, relative to the file. Off by default."""
    max_files: int = Field(default=100, ge=2, le=100_000)
    min_free_bytes: int = Field(default=1_000_000_000, ge=100_000, le=10**15, examples=["1_000_000_000"])
    """Free space to keep on the disk: the daemon deletes the oldest recordings for it."""


class LogSection(Section):
    """``[log]``."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["auto", "console", "json"] = "auto"


class FileSection(Section):
    """The top of the file. Its sections are read one by one, so that each problem names its section."""

    name: Name = Field(examples=['"drone0"'])
    private_key_file: FileName = Field(examples=['"drone0.key"'])
    listen: list[ListenAddress] = Field(default=[], examples=['["0.0.0.0:5790"]'])
    """Where peers reach this daemon. Empty: it only initiates."""
    previous_private_key_file: FileName | None = Field(default=None, examples=['"drone0.previous.key"'])
    """The old key while this daemon's key changes, for peers that do not know the new one yet."""
    control_socket: FileName | None = Field(default=None, examples=['"drone0.sock"'])
    """A Unix socket for status and commands, relative to the file. Off by default."""
    link: Any = None
    log: Any = None
    routing: Any = None
    metrics: Any = None
    recording: Any = None
    network: Any = None
    endpoint: Any = None
    relay: Any = None
    peer: Any = None
    member: Any = None
    relay_server: Any = None
