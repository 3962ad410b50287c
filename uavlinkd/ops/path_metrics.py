"""The paths of each peer as metrics.

A path has the labels ``peer``, ``path`` (the number of its slot, of which a peer has twelve), ``network`` (empty
without ``[[network]]``) and ``address``: of a path that is not configured only ``learned``. An attacker can cause
learned paths with any address, so their addresses must not become labels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.settings import Class

Status = Mapping[str, Any]

LABELS: Final = ("peer", "path", "network", "address")
LEARNED: Final = "learned"

_GAUGES: Final = {
    "round_trip_s": ("peer_path_round_trip_seconds", "Smoothed round-trip time along the path."),
    "jitter_s": ("peer_path_jitter_seconds", "Smoothed variation of the round-trip time along the path."),
    "lag_s": ("peer_path_lag_seconds", "How much later our copies arrive along the path than along the first one."),
}
_TOTALS: Final = {
    "bytes_received": ("peer_path_receive_bytes_total", "Bytes of authentic datagrams along the path."),
    "bytes_sent": ("peer_path_transmit_bytes_total", "Bytes of datagrams to the peer along the path."),
    "datagrams_received": ("peer_path_receive_datagrams_total", "Authentic datagrams along the path."),
    "datagrams_sent": ("peer_path_transmit_datagrams_total", "Datagrams to the peer along the path."),
    "duplicates": (
        "peer_path_duplicates_total",
        "Datagrams along the path that were copies of ones that had arrived already.",
    ),
}


class Family(NamedTuple):
    """One metric with its samples."""

    name: str
    text: str
    labels: Sequence[str]
    samples: Sequence[tuple[Sequence[str], float]]


def path_families(peers: Mapping[str, Status]) -> Iterator[Family]:
    """Every metric of paths."""
    paths = [(_labels(name, path), path) for name, peer in peers.items() for path in peer["paths"]]
    states = [
        ([*labels, condition.value], float(path["state"] == condition))
        for labels, path in paths
        for condition in PathCondition
    ]
    yield Family("peer_path_state", "1 for the state in which the path is.", [*LABELS, "state"], states)
    best = [(labels, float(path["role"] == "best")) for labels, path in paths]
    yield Family("peer_path_best", "1 if the path is the best one to the peer.", LABELS, best)
    carried = [([*labels, cls.value], float(cls in path["carries"])) for labels, path in paths for cls in Class]
    yield Family("peer_path_carries", "1 if frames of the class go along the path.", [*LABELS, "class"], carried)
    losses = [
        ([*labels, direction], path[f"loss_{direction}"]) for labels, path in paths for direction in ("in", "out")
    ]
    text = "Share of recent datagrams that the path lost."
    yield Family("peer_path_loss_ratio", text, [*LABELS, "direction"], losses)
    for key, (name, text) in _GAUGES.items():
        yield Family(name, text, LABELS, [(labels, path[key]) for labels, path in paths if path[key] is not None])
    for key, (name, text) in _TOTALS.items():
        yield Family(name, text, LABELS, [(labels, path[key]) for labels, path in paths])


def _labels(peer: str, path: Status) -> list[str]:
    address = path["address"] if path["is_configured"] else LEARNED
    return [peer, str(path["number"]), path["network"] or "", address]
