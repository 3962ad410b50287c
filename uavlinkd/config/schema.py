"""The keys of a configuration file, with their ranges and defaults: one class for each section.

README.md explains each key. The kinds of values are in :mod:`uavlinkd.config.values`, checks of several values in
:mod:`uavlinkd.config.checks`.
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


_MESSAGES = Field(default=None, examples=['["heartbeat", "telemetry"]'])
_RATES = Field(default=None, examples=["{ ATTITUDE = 10 }"])


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
    confidential: bool = False
    tag_bits: Literal[64, 96, 128, 256] = 128
    mac_key_bits: Literal[256, 512, 1024, 2048] = 256
    max_envelope_bytes: int = Field(
        default=c.DEFAULT_ENVELOPE_LIMIT, ge=c.MIN_ENVELOPE_LIMIT, le=c.MAX_ENVELOPE_LIMIT
    )

    keepalive_s: float = _seconds(c.KEEPALIVE_S, 0.1, 3600)
    lost_after_s: float = _seconds(c.LOST_AFTER_S, 0.2, 1200)
    retry_max_s: float = _seconds(c.RETRY_MAX_S, 0.05, 60)
    rekey_after_s: float = _seconds(c.REKEY_AFTER_S, 1, 3600)
    reject_after_s: float = _seconds(c.REJECT_AFTER_S, 1, 7200)
    probe_interval_s: float = _seconds(c.PROBE_INTERVAL_S, 0.1, 3600)

    budget_bits_s: Budget = Field(default=_EGRESS.budget_bits_s, ge=0, le=10**9)
    coalesce_s: float = _seconds(_EGRESS.coalesce_s, 0, 0.5)
    max_age_s: float = _seconds(_EGRESS.max_age_s, 0.1, 60)
    redundancy: Literal["critical", "all", "none"] = "critical"
    idle_probe_s: float = _seconds(c.PROBE_IDLE_S, 0, 3600)


class NetworkSection(Section):
    """``[[network]]``: an exit of this machine to the peers."""

    name: Name = Field(examples=['"lte"'])
    interface: Interface | None = Field(default=None, examples=['"wwan0"'])
    address: OwnAddress | None = Field(default=None, examples=['"10.0.0.5"'])
    serial: SerialLine | None = Field(default=None, examples=['"/dev/ttyUSB0:57600"'])
    air_bits_s: int | None = Field(default=None, ge=_LEAST_AIR, le=10_000_000, examples=["24000"])
    metered: bool = False
    budget_bits_s: Budget = Field(default=0, ge=0, le=10**9)


class PolicySection(Section):
    """The keys in ``[[peer]]`` and ``[[endpoint]]`` that limit messages.

    :func:`uavlinkd.mavlink.policy.settings.read_settings` checks them together.
    """

    role: Any = Field(default=None, examples=['"swarm-member"'])
    system_ids: Any = Field(default=None, examples=["[2]"])
    allow_in: Any = _MESSAGES
    deny_in: Any = _MESSAGES
    allow_out: Any = _MESSAGES
    deny_out: Any = _MESSAGES
    rate_in: Any = _RATES
    rate_out: Any = _RATES
    mavlink1: Any = Field(default=None, examples=["false"])
    ground_station: Any = Field(default=None, examples=["false"])


class KeySection(Section):
    """The keys in ``[[peer]]``, ``[[relay]]`` and ``[[member]]`` that say who another daemon is."""

    name: Name = Field(examples=['"drone1"'])
    public_key: PublicKey = Field(examples=['"…", what `uavlinkd pubkey` prints there'])
    psk_file: FileName | None = Field(default=None, examples=['"drone0-drone1.psk"'])
    previous_public_key: PublicKey | None = Field(default=None, examples=['"…", what its public key was'])


class PeerSection(LinkSection, PolicySection, KeySection):
    """``[[peer]]``: another daemon."""

    addresses: PeerAddresses = Field(default=[], examples=['["10.13.0.2:5790"]'])
    relays: list[Name] | None = Field(default=None, examples=["[]"])


class RelaySection(KeySection):
    """``[[relay]]``: a host that passes datagrams between this daemon and its peers, and cannot forge them."""

    addresses: PeerAddresses = Field(default=[], examples=['["relay.example.org:5790"]'])


class MemberSection(KeySection):
    """``[[member]]``: a daemon that may use this relay."""

    max_peers: int = Field(default=256, ge=1, le=4000)
    datagrams_s: int = Field(default=2000, ge=1, le=10**6)
    bits_s: int = Field(default=20_000_000, ge=LEAST_BUDGET, le=10**10, examples=["20_000_000"])


class RelayServerSection(Section):
    """``[relay_server]``: what a relay carries for all members together."""

    datagrams_s: int = Field(default=10**6, ge=1, le=10**6, examples=["100_000"])
    bits_s: int = Field(default=10**10, ge=LEAST_BUDGET, le=10**10, examples=["100_000_000"])


class EndpointSection(PolicySection):
    """``[[endpoint]]``: a local MAVLink port."""

    name: Name = Field(examples=['"autopilot"'])
    url: Url = Field(examples=['"udpin:127.0.0.1:14550"'])
    radio_status: bool = False
    status_text: bool = False


class RoutingSection(Section):
    """``[routing]``."""

    relay: bool = False


class MetricsSection(Section):
    """``[metrics]``."""

    listen: ListenAddress | None = Field(default=None, examples=['"127.0.0.1:9790"'])


class RecordingSection(Section):
    """``[recording]``."""

    folder: FileName | None = Field(default=None, examples=['"recordings"'])
    max_files: int = Field(default=100, ge=2, le=100_000)
    min_free_bytes: int = Field(default=1_000_000_000, ge=100_000, le=10**15, examples=["1_000_000_000"])


class LogSection(Section):
    """``[log]``."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["auto", "console", "json"] = "auto"


class FileSection(Section):
    """The top of the file. Its sections are read one by one, so that each problem names its section."""

    name: Name = Field(examples=['"drone0"'])
    private_key_file: FileName = Field(examples=['"drone0.key"'])
    listen: list[ListenAddress] = Field(default=[], examples=['["0.0.0.0:5790"]'])
    previous_private_key_file: FileName | None = Field(default=None, examples=['"drone0.previous.key"'])
    control_socket: FileName | None = Field(default=None, examples=['"drone0.sock"'])


SINGLE: dict[str, type[Section]] = {
    "link": LinkSection,
    "log": LogSection,
    "routing": RoutingSection,
    "metrics": MetricsSection,
    "recording": RecordingSection,
    "relay_server": RelayServerSection,
}
"""The sections that a file has once, such as ``[link]``."""
REPEATED: dict[str, type[Section]] = {
    "network": NetworkSection,
    "endpoint": EndpointSection,
    "peer": PeerSection,
    "member": MemberSection,
    "relay": RelaySection,
}
"""The sections that a file may have several times, such as ``[[peer]]``."""
