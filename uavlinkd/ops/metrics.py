"""The daemon's status as metrics for Prometheus, in its text format 0.0.4: a row for each metric.

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
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Final, NamedTuple

from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from uavlinkd import __version__
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.settings import Class
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops import LOG_SCHEMA, METRICS_SCHEMA, STATUS_SCHEMA
from uavlinkd.relay.forwarding import RelayReason

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
LEARNED: Final = "learned"
"""The label of an address that is not configured: an attacker can cause learned paths with any address."""
UNKNOWN: Final = 255
"""A modem's figure that it does not know."""

Status = dict[str, Any]
Part = tuple[tuple[str, ...], Status]
"""The values of the labels of a part of the daemon, and its part of the status."""
Row = tuple[str, ...]
"""A metric: its name, the key of its value in the part (with dots for keys inside), its text, and further labels.

The value is a number, or None for no sample; with labels it maps their values to numbers.
"""

_STATM = Path("/proc/self/statm")
_RELAY_REASONS = (
    *(DropReason.RELAY_MALFORMED, DropReason.RELAY_UNKNOWN_HANDLE, DropReason.RELAY_OVER_LIMIT),
    *RelayReason,
)


class MetricSection(NamedTuple):
    """The metrics of all parts of one kind."""

    labels: tuple[str, ...]
    parts: Callable[[Status], Iterable[Part]]
    rows: tuple[Row, ...]


def exposition(status: Status, uptime_s: float) -> bytes:
    """Write a status (:func:`uavlinkd.link.status.daemon_status`) as the text that Prometheus reads."""
    # Not the global registry of the library, which measures the process its own way.
    return generate_latest(_StatusCollector({**status, "uptime_s": uptime_s}))


class _StatusCollector(Collector):
    def __init__(self, status: Status) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        """Every metric of the daemon. One without a sample is left out."""
        for labels, parts, rows in _SECTIONS:
            present = list(parts(self._status))
            for name, key, text, *more in rows:
                make = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
                family = make(f"uavlinkd_{name}", text, labels=[*labels, *more])
                for values, part in present:
                    value: Any = reduce(getitem, key.split("."), part)
                    for label, number in value.items() if more else [((), value)]:
                        if number is not None:
                            family.add_metric([*values, *([label] if isinstance(label, str) else label)], number)
                if family.samples:
                    yield family


# The parts of a status, with what is derived for their metrics.


def _daemon(status: Status) -> Iterator[Part]:
    resident = None
    with suppress(OSError, ValueError, IndexError):
        resident = int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    facts = {
        "cpu_s": time.process_time(),
        "resident": resident,
        "finding": {tuple(finding[label] for label in _FINDING): 1 for finding in status["findings"]},
        "build": {(status["name"], *_BUILD.values()): 1},
        "schemas": {tuple(_SCHEMAS.values()): 1},
    }
    yield (), status | facts


def _dropping(status: Status) -> Iterator[Part]:
    for name, part in {"": status, **status["peers"]}.items():
        yield (name,), {"drops": {reason: part["drops"].get(reason, 0) for reason in DropReason}}


def _peers(status: Status) -> Iterator[Part]:
    for name, peer in status["peers"].items():
        session = peer["session"] or {}
        facts = {
            "is_up": peer["state"] == "up",
            "is_unverified": peer["freshness_unverified_s"] is not None,
            "info": {tuple(str(session[label]) for label in _SESSION): 1} if session else {},
            "loss": _loss(peer) if session else {},
            "refusals": _refusals(peer),
        }
        yield (name,), peer | facts


def _paths(status: Status) -> Iterator[Part]:
    for name, peer in status["peers"].items():
        for path in peer["paths"]:
            address = path["address"] if path["is_configured"] else LEARNED
            facts = {
                "states": {state: path["state"] == state for state in PathCondition},
                "is_best": path["role"] == "best",
                "classes": {cls: cls in path["carries"] for cls in Class},
                "loss": _loss(path),
            }
            yield (name, str(path["number"]), path["network"] or "", address), path | facts


def _lines(status: Status) -> Iterator[Part]:
    for name, network in status["networks"].items():
        if (line := network["serial"]) is not None:
            yield (name,), line | {"is_open": network["is_present"], "rate_bytes_s": line["rate_bits_s"] / 8}


def _radios(status: Status) -> Iterator[Part]:
    """What a modem reports may be forged on the line: it becomes values, not labels."""
    for name, line in _lines(status):
        if line["radio"] is not None:
            radio = {key: None if figure == UNKNOWN else figure for key, figure in line["radio"].items()}
            facts = {key: {"here": radio[key], "there": radio[f"rem{key}"]} for key in ("rssi", "noise")}
            free = line["radio"]["txbuf"]
            yield name, radio | facts | {"free": free / 100 if free <= 100 else None}


def _endpoints(status: Status) -> Iterator[Part]:
    for name, endpoint in status["endpoints"].items():
        yield (name,), endpoint | {"clients": len(endpoint["clients"]), "refusals": _refusals(endpoint)}


def _recording(status: Status) -> Iterator[Part]:
    if (recording := status["recording"]) is not None:
        yield (), recording


def _relay(status: Status) -> Iterator[Part]:
    if (relay := status["relay"]) is not None:
        yield (), relay | {"drops": {reason: relay["dropped"].get(reason, 0) for reason in _RELAY_REASONS}}


def _members(status: Status) -> Iterator[Part]:
    for _, relay in _relay(status):
        yield from (((name,), member) for name, member in relay["members"].items())


def _used_relays(status: Status) -> Iterator[Part]:
    for name, relay in status["relays"].items():
        states = {(peer, state): state == now for peer, now in relay["peers"].items() for state in _STATES}
        yield (name,), relay | {"is_up": relay["state"] == "up", "states": states}


def _loss(part: Status) -> dict[str, float]:
    return {"in": part["loss_in"], "out": part["loss_out"]}


def _refusals(part: Status) -> dict[tuple[str, str], int]:
    """By direction and reason, summed over the message types; the status has the counts of each type."""
    sums = {(direction, reason.value): 0 for direction in part["refused"] for reason in Refusal}
    for direction, messages in part["refused"].items():
        for counts in messages.values():
            for reason, count in counts.items():
                sums[direction, reason] += count
    return sums


_FINDING = ("cause", "severity", "subject", "name")
_REFUSED = ("direction", "reason")
_SESSION = ("suite", "mode", "tag_bits")
_STATES = ("bound", "waiting", "unanswered")
"""Of a peer at a relay."""
_BUILD = {"version": __version__, "python": platform.python_version()}
_SCHEMAS = {"status": str(STATUS_SCHEMA), "log": str(LOG_SCHEMA), "metrics": str(METRICS_SCHEMA)}

_OF_DAEMON: tuple[Row, ...] = (
    ("build_info", "build", "Name and version of the daemon.", "name", *_BUILD),
    ("schema_info", "schemas", "Versions of the names in the JSON of `status`, in log and metrics.", *_SCHEMAS),
    ("frames_pass", "frames_pass", "1 if every peer is up and no traffic is wholly refused."),
    ("uptime_seconds", "uptime_s", "Time since the daemon started."),
    ("cpu_seconds_total", "cpu_s", "CPU time of the daemon."),
    ("resident_memory_bytes", "resident", "Resident memory of the daemon."),
    ("finding", "finding", "1 for each problem that `uavlinkd status` shows.", *_FINDING),
    ("send_failures_total", "send_failures", "Datagrams the kernel refused to send.", "reason"),
    ("unrouted_frames_total", "unrouted", "Frames without a route.", "reason"),
    ("stale_frames_total", "stale", "Frames that waited while the daemon was stopped or suspended.", "source"),
)
_OF_DROPS: tuple[Row, ...] = (
    ("rx_dropped_total", "drops", "Dropped datagrams; no peer if one names no session of a peer.", "reason"),
)
_OF_PEER: tuple[Row, ...] = (
    ("peer_up", "is_up", "1 if the link to the peer is up."),
    ("peer_freshness_unverified", "is_unverified", "1 if the age of the peer's frames is not proved: no commands."),
    ("peer_info", "info", "Suite and mode of the session.", *_SESSION),
    ("path_loss_ratio", "loss", "Share of recent envelopes that were lost.", "direction"),
    ("peer_last_handshake_age_seconds", "handshake_s", "Time since the last handshake that established keys."),
    ("peer_last_received_age_seconds", "last_received_s", "Time since the last authentic datagram from the peer."),
    ("round_trip_seconds", "round_trip_s", "Round-trip time to the peer."),
    ("peer_receive_bytes_total", "bytes_received", "Bytes of datagrams from the peer."),
    ("peer_transmit_bytes_total", "bytes_sent", "Bytes of datagrams to the peer."),
    ("peer_elsewhere_bytes_total", "bytes_elsewhere", "Bytes of replies to unproven addresses: replayed datagrams."),
    ("peer_receive_envelopes_total", "envelopes_received", "Authentic envelopes from the peer, without duplicates."),
    ("peer_transmit_envelopes_total", "envelopes_sent", "Envelopes to the peer."),
    ("peer_receive_frames_total", "frames_received", "MAVLink frames from the peer."),
    ("peer_superseded_frames_total", "frames_superseded", "Frames that came after newer ones of another path."),
    ("peer_handshakes_total", "handshakes", "Handshakes that established keys."),
    ("peer_missing_envelopes_total", "envelopes_missing", "Envelopes that the peer sent and that did not arrive."),
    ("peer_out_of_order_envelopes_total", "envelopes_out_of_order", "Envelopes that arrived after later ones."),
    ("peer_unproven_paths_total", "paths_unproven", "Addresses of its envelopes that answered no question."),
    ("peer_unanswered_handshakes_total", "handshakes_unanswered", "Repeated handshakes while the peer was up."),
    ("peer_taken_cookies_total", "cookies_taken", "Cookies from the peer, which sends them under load."),
    ("peer_unanswered_echoes_total", "echoes_unanswered", "Echo requests that the peer did not answer."),
    ("peer_malformed_total", "malformed", "Malformed payloads and frames.", "reason"),
    ("peer_unsent_frames_total", "waiting_dropped", "Frames dropped while waiting for the peer's budget.", "reason"),
    ("peer_unsent_copies_total", "copies_dropped", "Copies for other paths that were not sent.", "reason"),
    ("peer_transmissions", "repair.transmissions", "How often each path gets a critical envelope; 1 without repair."),
    ("peer_repeats_total", "repair.datagrams", "Repeats of critical envelopes along lossy paths."),
    ("peer_repeat_bytes_total", "repair.bytes", "Bytes of these repeats, with IP and UDP headers."),
    ("peer_refused_frames_total", "refusals", "Frames from (in) and to (out) it that its policy refused.", *_REFUSED),
)
_OF_PATH: tuple[Row, ...] = (
    ("peer_path_state", "states", "1 for the state in which the path is.", "state"),
    ("peer_path_best", "is_best", "1 if the path is the best one to the peer."),
    ("peer_path_carries", "classes", "1 if frames of the class go along the path.", "class"),
    ("peer_path_loss_ratio", "loss", "Share of recent datagrams that the path lost.", "direction"),
    ("peer_path_round_trip_seconds", "round_trip_s", "Smoothed round-trip time along the path."),
    ("peer_path_jitter_seconds", "jitter_s", "Smoothed variation of the round-trip time along the path."),
    ("peer_path_lag_seconds", "lag_s", "How much later copies arrive along it than along the first path."),
    ("peer_path_receive_bytes_total", "bytes_received", "Bytes of authentic datagrams along the path."),
    ("peer_path_transmit_bytes_total", "bytes_sent", "Bytes of datagrams to the peer along the path."),
    ("peer_path_receive_datagrams_total", "datagrams_received", "Authentic datagrams along the path."),
    ("peer_path_transmit_datagrams_total", "datagrams_sent", "Datagrams to the peer along the path."),
    ("peer_path_duplicates_total", "duplicates", "Copies of datagrams that had arrived along another path."),
)
_OF_LINE: tuple[Row, ...] = (
    ("line_open", "is_open", "1 if the device of the serial network is open."),
    ("line_uses_cts", "uses_cts", "1 if the modem can hold this end by the CTS wire."),
    ("line_rate_bytes_per_second", "rate_bytes_s", "Rate at which this end may send now."),
    ("line_receive_datagrams_total", "datagrams_received", "Whole datagrams from the line."),
    ("line_receive_bytes_total", "bytes_received", "Bytes from the line, noise included."),
    ("line_transmit_bytes_total", "bytes_written", "Bytes to the line."),
    ("line_radio_reports_total", "reports", "RADIO_STATUS frames of the modem: its MAVLINK should be 0."),
    ("line_cts_held_seconds_total", "cts_held_s", "Time for which the modem held this end by the CTS wire."),
    ("line_discarded_total", "discarded", "Pieces between two delimiters that are not a datagram.", "reason"),
    ("line_discarded_bytes_total", "discarded_bytes", "Bytes of these pieces.", "reason"),
    ("line_failures_total", "failures", "Datagrams that the line dropped, and failures of the device.", "reason"),
)
_OF_RADIO: tuple[Row, ...] = (
    ("line_radio_rssi", "rssi", "Signal strength in the modem's units.", "end"),
    ("line_radio_noise", "noise", "Noise in the modem's units.", "end"),
    ("line_radio_free_buffer_ratio", "free", "Free part of the modem's send buffer."),
    ("line_radio_receive_errors_total", "rxerrors", "Damaged packets that the modem received, up to 65,535."),
    ("line_radio_corrected_total", "fixed", "Packets that the modem corrected, up to 65,535."),
)
_OF_ENDPOINT: tuple[Row, ...] = (
    ("endpoint_clients", "clients", "Clients of the endpoint."),
    ("endpoint_receive_bytes_total", "bytes_received", "Bytes from the clients of the endpoint."),
    ("endpoint_transmit_bytes_total", "bytes_sent", "Bytes to the clients of the endpoint."),
    ("endpoint_receive_frames_total", "frames_received", "MAVLink frames from the clients of the endpoint."),
    ("endpoint_transmit_frames_total", "frames_sent", "MAVLink frames to the clients of the endpoint."),
    ("endpoint_garbage_bytes_total", "garbage_bytes", "Bytes from clients that belong to no MAVLink frame."),
    ("endpoint_malformed_total", "faults", "Malformed input of clients.", "reason"),
    ("endpoint_failures_total", "failures", "Errors of the endpoint.", "reason"),
    ("endpoint_refused_frames_total", "refusals", "Frames from and to it that its policy refused.", *_REFUSED),
)
_OF_RELAY: tuple[Row, ...] = (
    ("relay_connections", "connections", "Connections between paths of members."),
    ("relay_dropped_total", "drops", "Datagrams for other members that were dropped.", "reason"),
)
_OF_MEMBER: tuple[Row, ...] = (
    ("relay_member_up", "is_up", "1 if the member has a session with this relay."),
    ("relay_member_bindings", "bound", "Members to which the member is connected."),
    ("relay_member_waiting", "waiting", "Members that it asks for, and that do not ask for it or are absent."),
    ("relay_member_ignored_binds_total", "binds_ignored", "Binds of the member above its limits."),
    ("relay_member_ignored_filter_tests_total", "filter_tests_ignored", "Its filter tests above its limit."),
    ("relay_member_forwarded_datagrams_total", "datagrams", "Datagrams of the member that were forwarded."),
    ("relay_member_forwarded_bytes_total", "bytes", "Bytes of these datagrams."),
    ("relay_member_over_limit_total", "over_limit", "Datagrams of the member that were dropped above its limits."),
)
_OF_USED_RELAY: tuple[Row, ...] = (
    ("used_relay_up", "is_up", "1 if this daemon has a session with the relay."),
    ("used_relay_round_trip_seconds", "round_trip_s", "Round-trip time to the relay."),
    ("used_relay_peer_state", "states", "1 for the state of the peer at the relay.", "peer", "state"),
    ("used_relay_receive_bytes_total", "bytes_received", "Bytes from the relay itself, without data of peers."),
    ("used_relay_transmit_bytes_total", "bytes_sent", "Bytes to the relay itself, without data for peers."),
)
_OF_RECORDING: tuple[Row, ...] = (
    ("recording_up", "is_recording", "1 if the last write succeeded."),
    ("recording_frames_total", "frames", "Frames written to recordings."),
    ("recording_bytes_total", "bytes", "Bytes written to recordings."),
    ("recording_lost_frames_total", "frames_lost", "Frames that a full, failing or slow disk did not record."),
    ("recording_failures_total", "failures", "Failed writes.", "reason"),
)
_SECTIONS = (
    MetricSection((), _daemon, _OF_DAEMON),
    MetricSection(("peer",), _dropping, _OF_DROPS),
    MetricSection(("peer",), _peers, _OF_PEER),
    MetricSection(("peer", "path", "network", "address"), _paths, _OF_PATH),
    MetricSection(("network",), _lines, _OF_LINE),
    MetricSection(("network",), _radios, _OF_RADIO),
    MetricSection(("endpoint",), _endpoints, _OF_ENDPOINT),
    MetricSection((), _relay, _OF_RELAY),
    MetricSection(("member",), _members, _OF_MEMBER),
    MetricSection(("relay",), _used_relays, _OF_USED_RELAY),
    MetricSection((), _recording, _OF_RECORDING),
)
