"""The daemon's status as metrics for Prometheus, in its text format 0.0.4.

Names follow https://prometheus.io/docs/practices/naming/: base units, and ``_total`` for counters. Label values are
names from the configuration and reasons from closed lists, so the network cannot increase their number. A counter
that shows an attack starts at zero: Prometheus cannot see an increase of a series that did not exist before.

Points in time are exported as ages: a drone without a set clock knows how old a handshake is, but not its date.

``prometheus_client`` writes the format. Only the metrics server imports this module: the library takes memory and
start time, which a daemon without metrics saves.
"""

from __future__ import annotations

import os
import platform
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from uavlinkd import __version__
from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.path_metrics import line_families, path_families
from uavlinkd.ops.relay_metrics import relay_families
from uavlinkd.ops.schema_versions import LOG_SCHEMA, METRICS_SCHEMA, STATUS_SCHEMA
from uavlinkd.ops.used_relay_metrics import used_relay_families

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4

Status = Mapping[str, Any]
Sample = tuple[Sequence[str], float]
"""Label values, and the value."""

_STATM = Path("/proc/self/statm")

_PEER_AGES = {
    "handshake_s": ("peer_last_handshake_age_seconds", "Time since the last handshake that established keys."),
    "last_received_s": ("peer_last_received_age_seconds", "Time since the last authentic datagram from the peer."),
    "round_trip_s": ("round_trip_seconds", "Round-trip time to the peer."),
}
_PEER_TOTALS = {
    "bytes_received": ("peer_receive_bytes_total", "Bytes of datagrams from the peer."),
    "bytes_sent": ("peer_transmit_bytes_total", "Bytes of datagrams to the peer."),
    "bytes_elsewhere": (
        "peer_elsewhere_bytes_total",
        "Bytes of replies to addresses that the peer has not proved: an attacker replays its datagrams.",
    ),
    "envelopes_received": ("peer_receive_envelopes_total", "Authentic envelopes from the peer, without duplicates."),
    "envelopes_sent": ("peer_transmit_envelopes_total", "Envelopes to the peer."),
    "frames_received": ("peer_receive_frames_total", "MAVLink frames from the peer."),
    "frames_superseded": (
        "peer_superseded_frames_total",
        "MAVLink frames from the peer that were dropped because a newer one arrived first along another path.",
    ),
    "handshakes": ("peer_handshakes_total", "Handshakes that established keys."),
    "envelopes_missing": ("peer_missing_envelopes_total", "Envelopes that the peer sent and that did not arrive."),
    "envelopes_out_of_order": ("peer_out_of_order_envelopes_total", "Envelopes that arrived after later ones."),
    "paths_unproven": (
        "peer_unproven_paths_total",
        "Addresses of the peer's envelopes from which no question was answered: the address is not the peer's.",
    ),
    "handshakes_unanswered": (
        "peer_unanswered_handshakes_total",
        "Handshakes for new keys that were repeated while the peer was up.",
    ),
    "cookies_taken": ("peer_taken_cookies_total", "Cookies received from the peer, which sends them under load."),
    "echoes_unanswered": ("peer_unanswered_echoes_total", "Echo requests that the peer did not answer."),
}
_ENDPOINT_TOTALS = {
    "bytes_received": ("endpoint_receive_bytes_total", "Bytes from the clients of the endpoint."),
    "bytes_sent": ("endpoint_transmit_bytes_total", "Bytes to the clients of the endpoint."),
    "frames_received": ("endpoint_receive_frames_total", "MAVLink frames from the clients of the endpoint."),
    "frames_sent": ("endpoint_transmit_frames_total", "MAVLink frames to the clients of the endpoint."),
    "garbage_bytes": ("endpoint_garbage_bytes_total", "Bytes from clients that belong to no MAVLink frame."),
}
_RECORDING_TOTALS = {
    "frames": ("recording_frames_total", "Frames written to recordings."),
    "bytes": ("recording_bytes_total", "Bytes written to recordings."),
    "frames_lost": ("recording_lost_frames_total", "Frames that a full, failing or slow disk did not record."),
}


def exposition(status: Status, uptime_s: float) -> bytes:
    """Write a status (:func:`uavlinkd.link.status.daemon_status`) as the text that Prometheus reads."""
    registry = CollectorRegistry()  # not the global one of the library, which measures the process its own way
    registry.register(_StatusCollector(status, uptime_s))
    return generate_latest(registry)


class _StatusCollector(Collector):
    """Makes metrics from one status."""

    def __init__(self, status: Status, uptime_s: float) -> None:
        self._status = status
        self._uptime_s = uptime_s

    def collect(self) -> Iterator[Metric]:
        """Every metric of the daemon."""
        status, peers, endpoints = self._status, self._status["peers"], self._status["endpoints"]
        yield from _daemon(status, self._uptime_s)
        yield _findings(status["findings"])
        yield from _links(peers)
        yield from (_family(*family) for family in path_families(peers))
        yield from (_family(*family) for family in line_families(status["networks"]))
        yield from _drops(status)
        yield from _totals("peer", peers, _PEER_TOTALS)
        yield _reasons("peer_malformed_total", "Malformed payloads and frames.", "peer", peers, "malformed")
        text = "Frames that waited for the peer's budget and were dropped."
        yield _reasons("peer_unsent_frames_total", text, "peer", peers, "waiting_dropped")
        text = "Copies of envelopes for other paths that were not sent."
        yield _reasons("peer_unsent_copies_total", text, "peer", peers, "copies_dropped")
        yield from _repair(peers)
        yield _refused("peer", peers)
        clients = [([name], len(endpoint["clients"])) for name, endpoint in endpoints.items()]
        yield _family("endpoint_clients", "Clients of the endpoint.", ["endpoint"], clients)
        yield from _totals("endpoint", endpoints, _ENDPOINT_TOTALS)
        yield _reasons("endpoint_malformed_total", "Malformed input of clients.", "endpoint", endpoints, "faults")
        yield _reasons("endpoint_failures_total", "Errors of the endpoint.", "endpoint", endpoints, "failures")
        yield _refused("endpoint", endpoints)
        yield from (_family(*family) for family in relay_families(status["relay"]))
        yield from (_family(*family) for family in used_relay_families(status["relays"]))
        yield from _recording(status["recording"])


def _daemon(status: Status, uptime_s: float) -> Iterator[Metric]:
    build = {"name": status["name"], "version": __version__, "python": platform.python_version()}
    yield _family("build_info", "Name and version of the daemon.", [*build], [([*build.values()], 1)])
    schemas = {"status": STATUS_SCHEMA, "log": LOG_SCHEMA, "metrics": METRICS_SCHEMA}
    text = "Versions of the names in the JSON of `status`, in the log and in the metrics."
    yield _family("schema_info", text, [*schemas], [([*map(str, schemas.values())], 1)])
    passes = status["frames_pass"]
    yield _family("frames_pass", "1 if every peer is up and no traffic is wholly refused.", [], [([], passes)])
    yield _family("uptime_seconds", "Time since the daemon started.", [], [([], uptime_s)])
    yield _family("cpu_seconds_total", "CPU time of the daemon.", [], [([], time.process_time())])
    with suppress(OSError, ValueError, IndexError):
        resident = int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        yield _family("resident_memory_bytes", "Resident memory of the daemon.", [], [([], resident)])


def _findings(findings: Sequence[Mapping[str, str]]) -> Metric:
    """One sample per cause and name: causes are a closed list, names are in the configuration."""
    labels = ("cause", "severity", "subject", "name")
    problems = dict.fromkeys(tuple(finding[label] for label in labels) for finding in findings)
    return _family(
        "finding", "1 for each problem that `uavlinkd status` shows.", labels, [(key, 1) for key in problems]
    )


def _links(peers: Mapping[str, Status]) -> Iterator[Metric]:
    up = [([name], peer["state"] == "up") for name, peer in peers.items()]
    yield _family("peer_up", "1 if the link to the peer is up.", ["peer"], up)
    unverified = [([name], peer["freshness_unverified_s"] is not None) for name, peer in peers.items()]
    text = "1 if the peer does not prove the freshness of its frames: the daemon drops its commands."
    yield _family("peer_freshness_unverified", text, ["peer"], unverified)
    linked = {name: peer for name, peer in peers.items() if peer["session"] is not None}
    shown = ["suite", "mode", "tag_bits"]
    sessions = [([name, *(str(peer["session"][key]) for key in shown)], 1) for name, peer in linked.items()]
    yield _family("peer_info", "Suite and mode of the session.", ["peer", *shown], sessions)
    losses = [
        ([name, direction], peer[f"loss_{direction}"]) for name, peer in linked.items() for direction in ("in", "out")
    ]
    yield _family("path_loss_ratio", "Share of recent envelopes that were lost.", ["peer", "direction"], losses)
    for key, (metric, text) in _PEER_AGES.items():
        yield _family(
            metric, text, ["peer"], [([name], peer[key]) for name, peer in peers.items() if peer[key] is not None]
        )


def _repair(peers: Mapping[str, Status]) -> Iterator[Metric]:
    repairs = [([name], peer["repair"]) for name, peer in peers.items()]
    text = "How often a critical envelope is sent along each path; 1 while repair is off."
    yield _family("peer_transmissions", text, ["peer"], [(name, repair["transmissions"]) for name, repair in repairs])
    text = "Repeats of critical envelopes along lossy paths."
    yield _family("peer_repeats_total", text, ["peer"], [(name, repair["datagrams"]) for name, repair in repairs])
    text = "Bytes of these repeats, with IP and UDP headers."
    yield _family("peer_repeat_bytes_total", text, ["peer"], [(name, repair["bytes"]) for name, repair in repairs])


def _drops(status: Status) -> Iterator[Metric]:
    by_peer = {"": status["drops"], **{name: peer["drops"] for name, peer in status["peers"].items()}}
    yield _family(
        "rx_dropped_total",
        "Dropped datagrams; the peer is empty if the datagram names no session of a peer.",
        ["peer", "reason"],
        [([peer, reason], drops.get(reason, 0)) for peer, drops in by_peer.items() for reason in DropReason],
    )
    yield _counts("send_failures_total", "Datagrams the kernel refused to send.", "reason", status["send_failures"])
    yield _counts("unrouted_frames_total", "Frames without a route.", "reason", status["unrouted"])
    text = "Frames dropped because they waited while the daemon was stopped or suspended."
    yield _counts("stale_frames_total", text, "source", status["stale"])


def _recording(recording: Status | None) -> Iterator[Metric]:
    if recording is None:
        return
    yield _family("recording_up", "1 if the last write succeeded.", [], [([], recording["is_recording"])])
    for key, (name, text) in _RECORDING_TOTALS.items():
        yield _family(name, text, [], [([], recording[key])])
    yield _counts("recording_failures_total", "Failed writes.", "reason", recording["failures"])


def _counts(name: str, text: str, label: str, counts: Mapping[str, int]) -> Metric:
    return _family(name, text, [label], [([key], count) for key, count in counts.items()])


def _totals(kind: str, parts: Mapping[str, Status], names: Mapping[str, tuple[str, str]]) -> Iterator[Metric]:
    for key, (name, text) in names.items():
        yield _family(name, text, [kind], [([part], status[key]) for part, status in parts.items()])


def _reasons(name: str, text: str, kind: str, parts: Mapping[str, Status], key: str) -> Metric:
    counts = [([part, reason], count) for part, status in parts.items() for reason, count in status[key].items()]
    return _family(name, text, [kind, "reason"], counts)


def _refused(kind: str, parts: Mapping[str, Status]) -> Metric:
    """Summed over the message types; the status has the counts of each type."""
    samples: list[Sample] = []
    for part, status in parts.items():
        for direction, messages in status["refused"].items():
            sums = Counter[str]()
            for counts in messages.values():
                sums.update(counts)
            samples += [([part, direction, reason], sums[reason]) for reason in Refusal]
    text = f"Frames from (in) and to (out) the {kind} that its policy refused."
    return _family(f"{kind}_refused_frames_total", text, [kind, "direction", "reason"], samples)


def _family(name: str, text: str, labels: Sequence[str], samples: Iterable[Sample]) -> Metric:
    make = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
    family = make(f"uavlinkd_{name}", text, labels=labels)
    for values, value in samples:
        family.add_metric(values, value)
    return family
