"""The relays that this daemon uses as metrics. A relay's own metrics are in :mod:`.relay_metrics`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from uavlinkd.ops.path_metrics import Family

STATES: Final = ("bound", "waiting", "unanswered")
"""Of a peer at a relay."""
_TOTALS: Final = {
    "bytes_received": ("used_relay_receive_bytes_total", "Bytes from the relay itself, without data of peers."),
    "bytes_sent": ("used_relay_transmit_bytes_total", "Bytes to the relay itself, without data for peers."),
}


def used_relay_families(relays: Mapping[str, Mapping[str, Any]]) -> Iterator[Family]:
    """Every metric of the relays in this daemon's configuration."""
    up = [([name], float(relay["state"] == "up")) for name, relay in relays.items()]
    yield Family("used_relay_up", "1 if this daemon has a session with the relay.", ["relay"], up)
    measured = [
        ([name], relay["round_trip_s"]) for name, relay in relays.items() if relay["round_trip_s"] is not None
    ]
    yield Family("used_relay_round_trip_seconds", "Round-trip time to the relay.", ["relay"], measured)
    states = [
        ([name, peer, state], float(state == current))
        for name, relay in relays.items()
        for peer, current in relay["peers"].items()
        for state in STATES
    ]
    text = "1 for the state of the peer at the relay: bound, waiting for the peer to ask too, or unanswered."
    yield Family("used_relay_peer_state", text, ["relay", "peer", "state"], states)
    for key, (name, text) in _TOTALS.items():
        yield Family(name, text, ["relay"], [([relay], status[key]) for relay, status in relays.items()])
