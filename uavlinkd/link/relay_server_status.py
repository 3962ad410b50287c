"""The status of a relay: plain values for JSON, without secrets."""

from __future__ import annotations

from uavlinkd.config.keys import encode_key
from uavlinkd.relay.service import RelayMember, RelayService
from uavlinkd.system.addresses import Address


def relay_status(relay: RelayService, now: float) -> dict[str, object]:
    """The members, and what was forwarded and dropped. Times are ages in seconds."""
    return {
        "members": {member.settings.name: _member(relay, member, now) for member in relay.members.values()},
        "connections": relay.bindings.connections,
        "dropped": {reason.value: count for reason, count in relay.forwarding.dropped.items()},
    }


def _member(relay: RelayService, member: RelayMember, now: float) -> dict[str, object]:
    peer, meter = member.peer, member.meter
    bound, waiting = relay.bindings.peers_of(member.key)
    return {
        "public_key": encode_key(member.key),
        "is_up": peer.is_up,
        "since_s": now - member.since,
        "addresses": [str(Address.of(state.path.address)) for state in peer.paths.states if state.is_validated],
        "bound": bound,
        "waiting": waiting,
        "binds_ignored": member.binds_ignored + relay.bindings.refused(member.key),
        "filter_tests_ignored": member.filter_tests_ignored,
        "datagrams": meter.datagrams,
        "bytes": meter.bytes,
        "over_limit": meter.over_limit,
    }
