"""Reasons of the daemon itself for drops, beside those of the core and of the policies."""

from __future__ import annotations

from uavlinkd.core.drops import Reason


class ShellReason(Reason):
    """Why the daemon drops frames and datagrams outside the core and the policies."""

    STALE = "stale", "the frames waited while the daemon was stopped or suspended"
    SUPERSEDED = "superseded", "newer states arrived first along another path of the peer"
    COPY_OVER_BUDGET = "copy_over_budget", "copies waited too long for a budget"
    COPY_REPLACED = "copy_replaced", "newer states replaced copies that waited"
    RELAY_HANDLE_GONE = "relay_handle_gone", "a datagram for a relay has a handle that the relay assigns no more"
