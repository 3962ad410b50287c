"""The relay of a daemon as metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from uavlinkd.core.drops import DropReason
from uavlinkd.ops.path_metrics import Family
from uavlinkd.relay.forwarding import RelayReason

REASONS: Final = (
    *(DropReason.RELAY_MALFORMED, DropReason.RELAY_UNKNOWN_HANDLE, DropReason.RELAY_OVER_LIMIT),
    *RelayReason,
)
_OF_MEMBER: Final = {
    "is_up": ("relay_member_up", "1 if the member has a session with this relay."),
    "bound": ("relay_member_bindings", "Members to which the member is connected."),
    "waiting": (
        "relay_member_waiting",
        "Members that the member asks for, and that do not ask for it or are absent.",
    ),
    "binds_ignored": ("relay_member_ignored_binds_total", "Binds of the member above its limits."),
    "filter_tests_ignored": (
        "relay_member_ignored_filter_tests_total",
        "Filter tests of the member above its limit, or along a path that is not validated.",
    ),
    "datagrams": ("relay_member_forwarded_datagrams_total", "Datagrams of the member that were forwarded."),
    "bytes": ("relay_member_forwarded_bytes_total", "Bytes of these datagrams."),
    "over_limit": ("relay_member_over_limit_total", "Datagrams of the member that were dropped above its limits."),
}


def relay_families(relay: Mapping[str, Any] | None) -> Iterator[Family]:
    """Every metric of a relay; none if the daemon is not one."""
    if relay is None:
        return
    members, dropped = relay["members"], relay["dropped"]
    yield Family("relay_connections", "Connections between paths of members.", [], [([], relay["connections"])])
    for key, (name, text) in _OF_MEMBER.items():
        yield Family(name, text, ["member"], [([member], float(facts[key])) for member, facts in members.items()])
    text = "Datagrams for other members that were dropped."
    yield Family("relay_dropped_total", text, ["reason"], [([reason], dropped.get(reason, 0)) for reason in REASONS])
