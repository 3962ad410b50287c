"""What a configuration tells the core, as plain values. The checks that make errors readable are the shell's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.suites import X25519, Suite

Screen = Callable[[bytes], tuple[bytes, bytes]]
"""Splits an authentic payload into the frames that may pass while freshness is unverified, and those that wait."""


def hold_all(payload: bytes) -> tuple[bytes, bytes]:
    """The screen of a node that knows nothing about frames: all of them wait."""
    return b"", payload


class Class(StrEnum):
    """What a lost or late frame costs. It decides along which paths the frame goes."""

    CRITICAL = "critical"
    """It must arrive: along every proven path."""
    STREAM = "stream"
    """Another one follows: along the best path."""
    BULK = "bulk"
    """It can wait: along the best path that is not metered."""


class Redundancy(StrEnum):
    """Which classes are sent along every proven path."""

    CRITICAL = "critical"
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Timers:
    """Durations in seconds on the monotonic clock; the reasons are in :mod:`uavlinkd.protocol.constants`."""

    rekey_after_s: float = c.REKEY_AFTER_S
    reject_after_s: float = c.REJECT_AFTER_S
    retry_min_s: float = c.RETRY_MIN_S
    retry_max_s: float = c.RETRY_MAX_S
    keepalive_s: float = c.KEEPALIVE_S
    echo_after_s: float = c.ECHO_AFTER_S
    handshake_after_s: float = c.HANDSHAKE_AFTER_S
    lost_after_s: float = c.LOST_AFTER_S
    probe_interval_s: float = c.PROBE_INTERVAL_S


@dataclass(frozen=True, slots=True)
class Link:
    """How one peer is spoken to. ``suites`` are accepted, the first is offered.

    Tag length and confidentiality are the least this side takes: the stronger of both ends' counts.
    """

    suites: tuple[Suite, ...] = (X25519,)
    confidential: bool = False
    tag_bytes: int = 16
    max_envelope: int = c.DEFAULT_ENVELOPE_LIMIT
    timers: Timers = field(default_factory=Timers)
    features: int = c.FEATURE_REFUSALS | c.FEATURE_PROBLEMS
    """Bits of the protocol extensions that this side offers. A session has those that both offer."""
    redundancy: Redundancy = Redundancy.CRITICAL
    idle_probe_s: float = c.PROBE_IDLE_S
    """Between questions along a metered path that is not needed, and while no frames are sent. 0: none."""
    verify_interval_s: float = field(default=c.VERIFY_INTERVAL_S, compare=False)
    """How often freshness is verified while frames arrive. A session keeps the interval that it began with."""


@dataclass(frozen=True, slots=True)
class PeerSettings:
    """A peer: its name here, its static X25519 public key, the PSK shared with it, if any."""

    name: str
    public_key: bytes
    psk: Secret | None = None
    link: Link = field(default_factory=Link)
    initiates: bool = True
    """Whether this side makes sessions too. A relay leaves that to its members."""
    is_certified: bool = False
    """Whether it is a peer by its certificate, and not by the configuration."""
