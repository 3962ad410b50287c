"""The link keys of a configuration as settings of the core."""

from __future__ import annotations

from typing import Final

from uavlinkd.config.schema import LinkSection
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.settings import Link, Redundancy, Timers
from uavlinkd.system.addresses import IPV6_UDP_BYTES

VERIFYING_SHARE: Final = 0.05
"""Share of the budget that the echo requests and replies of one end may use."""


def link_of(keys: LinkSection) -> Link:
    """The settings of one link. ``lost_after_s`` sets the pace of the questions before it."""
    tag_bytes, pace = keys.tag_bits // 8, keys.lost_after_s / c.LOST_AFTER_S
    return Link(
        suites=tuple(keys.suites),
        confidential=keys.confidential,
        tag_bytes=tag_bytes,
        mac_key_bits=keys.mac_key_bits,
        max_envelope=keys.max_envelope_bytes,
        timers=Timers(
            rekey_after_s=keys.rekey_after_s,
            reject_after_s=keys.reject_after_s,
            retry_min_s=min(c.RETRY_MIN_S, keys.retry_max_s),
            retry_max_s=keys.retry_max_s,
            keepalive_s=keys.keepalive_s,
            echo_after_s=pace * c.ECHO_AFTER_S,
            handshake_after_s=pace * c.HANDSHAKE_AFTER_S,
            lost_after_s=keys.lost_after_s,
            probe_interval_s=keys.probe_interval_s,
        ),
        redundancy=Redundancy(keys.redundancy),
        idle_probe_s=keys.idle_probe_s,
        verify_interval_s=verify_interval_s(keys.budget_bits_s, tag_bytes),
    )


def verify_interval_s(budget_bits_s: int, tag_bytes: int) -> float:
    """Seconds between two echo requests, at least :data:`c.VERIFY_INTERVAL_S`. A budget of 0 means unlimited.

    The request and its reply count, with the long header and over IPv6: their largest size.
    """
    if not budget_bits_s:
        return c.VERIFY_INTERVAL_S
    records = sum(len(wire.Echo(is_reply, 0, 0, 0).encode()) for is_reply in (False, True))
    wire_bytes = records + 2 * (wire.LONG_HEADER_BYTES + tag_bytes + IPV6_UDP_BYTES)
    return max(c.VERIFY_INTERVAL_S, 8 * wire_bytes / (VERIFYING_SHARE * budget_bits_s))
