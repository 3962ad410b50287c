"""The paths of each peer, and the serial lines, as metrics.

A path has the labels ``peer``, ``path`` (the number of its slot, of which a peer has twelve), ``network`` (empty
without ``[[network]]``) and ``address``: of a path that is not configured only ``learned``. An attacker can cause
learned paths with any address, so their addresses must not become labels.

A line has the label ``network``. What its modem reports may be forged on the line: it becomes values, not labels.
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


UNKNOWN: Final = 255
"""A modem's figure that it does not know."""
_LINE_TOTALS: Final = {
    "datagrams_received": ("line_receive_datagrams_total", "Whole datagrams from the line."),
    "bytes_received": ("line_receive_bytes_total", "Bytes from the line, noise included."),
    "bytes_written": ("line_transmit_bytes_total", "Bytes to the line."),
    "reports": ("line_radio_reports_total", "RADIO_STATUS frames of the modem: its MAVLINK should be 0."),
    "cts_held_s": ("line_cts_held_seconds_total", "Time for which the modem held this end by the CTS wire."),
}
_LINE_REASONS: Final = {
    "discarded": ("line_discarded_total", "Pieces between two delimiters that are not a datagram."),
    "discarded_bytes": ("line_discarded_bytes_total", "Bytes of these pieces."),
    "failures": ("line_failures_total", "Datagrams that the line dropped, and failures to open or keep the device."),
}
_RADIO: Final = (
    ("line_radio_rssi", "rssi", "remrssi", "Signal strength in the modem's units."),
    ("line_radio_noise", "noise", "remnoise", "Noise in the modem's units."),
)
"""Metric, and the figures of this end and of the other one."""
_RADIO_TOTALS: Final = {
    "rxerrors": ("line_radio_receive_errors_total", "Damaged packets that the modem received; it counts to 65,535."),
    "fixed": ("line_radio_corrected_total", "Packets that the modem corrected; it counts to 65,535."),
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


def line_families(networks: Mapping[str, Status]) -> Iterator[Family]:
    """Every metric of serial lines. What the modem reports has samples while it reports."""
    labels, by_reason = ["network"], ["network", "reason"]
    lines = {name: network["serial"] for name, network in networks.items() if network["serial"] is not None}
    opened = [([name], float(networks[name]["is_present"])) for name in lines]
    yield Family("line_open", "1 if the device of the serial network is open.", labels, opened)
    uses_cts = [([name], float(line["uses_cts"])) for name, line in lines.items()]
    yield Family("line_uses_cts", "1 if the modem can hold this end by the CTS wire.", labels, uses_cts)
    rates = [([name], line["rate_bits_s"] / 8) for name, line in lines.items()]
    yield Family("line_rate_bytes_per_second", "Rate at which this end may send now.", labels, rates)
    for key, (metric, text) in _LINE_TOTALS.items():
        yield Family(metric, text, labels, [([name], line[key]) for name, line in lines.items()])
    for key, (metric, text) in _LINE_REASONS.items():
        counts = [([name, reason], count) for name, line in lines.items() for reason, count in line[key].items()]
        yield Family(metric, text, by_reason, counts)
    radios = {name: line["radio"] for name, line in lines.items() if line["radio"] is not None}
    for metric, here, there, text in _RADIO:
        figures = [
            ([name, end], radio[key])
            for name, radio in radios.items()
            for end, key in (("here", here), ("there", there))
            if radio[key] != UNKNOWN
        ]
        yield Family(metric, text, ["network", "end"], figures)
    free = [([name], radio["txbuf"] / 100) for name, radio in radios.items() if radio["txbuf"] <= 100]
    yield Family("line_radio_free_buffer_ratio", "Free part of the modem's send buffer.", labels, free)
    for key, (metric, text) in _RADIO_TOTALS.items():
        yield Family(metric, text, labels, [([name], radio[key]) for name, radio in radios.items()])
