"""The link keys of a configuration as settings of the core."""

from __future__ import annotations

from uavlinkd.config.pace import verify_interval_s
from uavlinkd.config.schema import LinkSection
from uavlinkd.core.settings import Link, Redundancy, Timers


def link_of(keys: LinkSection) -> Link:
    """The settings of one link."""
    tag_bytes = keys.tag_bits // 8
    return Link(
        suites=tuple(keys.suites),
        confidential=keys.confidential,
        tag_bytes=tag_bytes,
        mac_key_bits=keys.mac_key_bits,
        max_envelope=keys.max_envelope_bytes,
        timers=Timers(
            rekey_after_s=keys.rekey_after_s,
            reject_after_s=keys.reject_after_s,
            retry_min_s=keys.retry_min_s,
            retry_max_s=keys.retry_max_s,
            keepalive_s=keys.keepalive_s,
            echo_after_s=keys.echo_after_s,
            handshake_after_s=keys.handshake_after_s,
            lost_after_s=keys.lost_after_s,
            probe_interval_s=keys.probe_interval_s,
        ),
        redundancy=Redundancy(keys.redundancy),
        idle_probe_s=keys.idle_probe_s,
        verify_interval_s=verify_interval_s(keys.budget_bits_s, tag_bytes),
    )
