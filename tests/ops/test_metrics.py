"""The metrics: each number of the status under its name and labels, in a format that Prometheus accepts."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
import sys
from typing import Any

import pytest

from tests.needs import need
from uavlinkd import __version__
from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.metrics import exposition

PATH: dict[str, Any] = {
    "number": 1,
    "network": "lte",
    "address": "203.0.113.7:5790",
    "is_configured": True,
    "state": "usable",
    "role": "best",
    "carries": ["critical", "stream", "bulk"],
    "round_trip_s": 0.06,
    "jitter_s": 0.004,
    "lag_s": 0.0,
    "loss_in": 0.25,
    "loss_out": 0.75,
    "bytes_received": 61,
    "bytes_sent": 62,
    "datagrams_received": 63,
    "datagrams_sent": 64,
    "duplicates": 65,
}
UNKNOWN_PATH = dict.fromkeys(("network", "round_trip_s", "jitter_s", "lag_s"))
LEARNED_PATH = {
    **PATH,
    **UNKNOWN_PATH,
    "number": 2,
    "address": "198.51.100.66:4000",
    "is_configured": False,
    "state": "down",
    "role": "standby",
    "carries": ["critical"],
}
PEER: dict[str, Any] = {
    "state": "up",
    "paths": [PATH, LEARNED_PATH],
    "session": {"suite": "x25519", "mode": "authenticated", "tag_bits": 128},
    "handshake_s": 12.5,
    "last_received_s": 0.25,
    "round_trip_s": 0.003,
    "freshness_unverified_s": None,
    "loss_in": 0.125,
    "loss_out": 0.5,
    "handshakes": 3,
    "envelopes_sent": 10,
    "envelopes_received": 11,
    "bytes_sent": 1_000_000_000_000,
    "bytes_received": 13,
    "bytes_elsewhere": 56,
    "envelopes_missing": 50,
    "envelopes_out_of_order": 51,
    "paths_unproven": 52,
    "echoes_unanswered": 53,
    "handshakes_unanswered": 54,
    "cookies_taken": 55,
    "frames_received": 14,
    "frames_superseded": 9,
    "malformed": {"bad_crc": 15},
    "waiting_dropped": {"stale": 16},
    "copies_dropped": {"copy_over_budget": 8},
    "repair": {"is_on": True, "on_s": 3.0, "transmissions": 5, "datagrams": 57, "bytes": 58},
    "drops": {"bad_tag": 17},
    "refused": {
        "in": {"PING": {"message_not_allowed": 1}, "PARAM_SET": {"message_not_allowed": 2, "rate_limited": 4}},
        "out": {},
    },
}
UNKNOWN = dict.fromkeys(("session", "handshake_s", "last_received_s", "round_trip_s"))
NEVER_UP = {**PEER, **UNKNOWN, "state": "waiting", "paths": []}
FINDING = {
    "cause": "wrong_psk",
    "severity": "fault",
    "subject": "peer",
    "name": "drone2",
    "text": "the PSKs differ",
    "remedy": "give both ends the same psk_file",
}
RADIO = {"rssi": 200, "remrssi": 255, "txbuf": 98, "noise": 50, "remnoise": 51, "rxerrors": 77, "fixed": 78}
LINE: dict[str, Any] = {
    "rate_bits_s": 9600,
    "uses_cts": True,
    "cts_held_s": 1.5,
    "discarded": {"bad_cobs": 0, "bad_crc": 70, "too_long": 0},
    "discarded_bytes": {"bad_cobs": 0, "bad_crc": 71, "too_long": 0},
    "datagrams_received": 72,
    "bytes_received": 73,
    "bytes_written": 74,
    "failures": {"LINE_FULL": 75},
    "reports": 76,
    "radio": RADIO,
}
NETWORKS: dict[str, Any] = {
    "lte": {"is_present": True, "serial": None},
    "sik": {"is_present": True, "serial": LINE},
    "quiet": {"is_present": False, "serial": {**LINE, "uses_cts": False, "radio": None}},
}
MEMBER = {
    "is_up": True,
    "bound": 2,
    "waiting": 1,
    "binds_ignored": 3,
    "filter_tests_ignored": 2,
    "datagrams": 40,
    "bytes": 50,
    "over_limit": 6,
}
STATUS: dict[str, Any] = {
    "relay": {"connections": 4, "dropped": {"relay_over_limit": 6}, "members": {"drone1": MEMBER}},
    "name": "drone0",
    "networks": NETWORKS,
    "frames_pass": False,
    "findings": [FINDING, FINDING | {"text": "other evidence of the same"}],
    "peers": {"drone1": PEER, "drone2": NEVER_UP},
    "endpoints": {
        "autopilot": {
            "clients": {"127.0.0.1:14550": {}, "127.0.0.1:14551": {}},
            "frames_received": 20,
            "frames_sent": 21,
            "bytes_received": 22,
            "bytes_sent": 23,
            "garbage_bytes": 24,
            "faults": {"not_mavlink": 25},
            "failures": {"ECONNREFUSED": 26},
            "refused": {"in": {}, "out": {"PING": {"setup_signing": 27}}},
        }
    },
    "relays": {
        "vps": {
            "state": "up",
            "round_trip_s": 0.05,
            "bytes_received": 50,
            "bytes_sent": 51,
            "peers": {"drone1": "bound", "drone2": "waiting"},
        }
    },
    "drops": {"malformed": 30},
    "unrouted": {"unknown_target": 31},
    "send_failures": {"ENETUNREACH": 32},
    "stale": {"autopilot": 33},
    "recording": {"is_recording": True, "frames": 40, "bytes": 41, "frames_lost": 42, "failures": {"ENOSPC": 43}},
}

_SAMPLE = re.compile(r"(\w+)(?:\{(.*)\})? (\S+)")
_LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"(?:,|$)')


def samples(text: bytes) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Values by name and labels; each pair occurs once."""
    values: dict[tuple[str, frozenset[tuple[str, str]]], float] = {}
    for line in text.decode().splitlines():
        if line.startswith("#"):
            continue
        match = _SAMPLE.fullmatch(line)
        assert match is not None, line
        labels = match[2] or ""
        assert _LABEL.sub("", labels) == "", line
        key = (match[1], frozenset(_LABEL.findall(labels)))
        assert key not in values, line
        values[key] = float(match[3])
    return values


def value(name: str, /, **labels: str) -> float:
    """One sample of the status above."""
    return samples(exposition(STATUS, 5.0))[f"uavlinkd_{name}", frozenset(labels.items())]


LTE = {"peer": "drone1", "path": "1", "network": "lte", "address": "203.0.113.7:5790"}
OTHER = {"peer": "drone1", "path": "2", "network": "", "address": "learned"}
SIK = {"network": "sik"}


@pytest.mark.parametrize(
    ("name", "labels", "expected"),
    [
        ("uptime_seconds", {}, 5.0),
        ("relay_connections", {}, 4),
        ("relay_member_up", {"member": "drone1"}, 1),
        ("relay_member_bindings", {"member": "drone1"}, 2),
        ("relay_member_waiting", {"member": "drone1"}, 1),
        ("relay_member_ignored_binds_total", {"member": "drone1"}, 3),
        ("relay_member_ignored_filter_tests_total", {"member": "drone1"}, 2),
        ("relay_member_forwarded_datagrams_total", {"member": "drone1"}, 40),
        ("relay_member_forwarded_bytes_total", {"member": "drone1"}, 50),
        ("relay_member_over_limit_total", {"member": "drone1"}, 6),
        ("relay_dropped_total", {"reason": "relay_over_limit"}, 6),
        ("relay_dropped_total", {"reason": "relay_unknown_handle"}, 0),
        ("schema_info", {"status": "2", "log": "1", "metrics": "2"}, 1),
        ("frames_pass", {}, 0),
        ("finding", {"cause": "wrong_psk", "severity": "fault", "subject": "peer", "name": "drone2"}, 1),
        ("peer_up", {"peer": "drone1"}, 1),
        ("peer_up", {"peer": "drone2"}, 0),
        ("peer_info", {"peer": "drone1", "suite": "x25519", "mode": "authenticated", "tag_bits": "128"}, 1),
        ("path_loss_ratio", {"peer": "drone1", "direction": "in"}, 0.125),
        ("path_loss_ratio", {"peer": "drone1", "direction": "out"}, 0.5),
        ("peer_last_handshake_age_seconds", {"peer": "drone1"}, 12.5),
        ("peer_last_received_age_seconds", {"peer": "drone1"}, 0.25),
        ("round_trip_seconds", {"peer": "drone1"}, 0.003),
        ("peer_freshness_unverified", {"peer": "drone1"}, 0),
        ("peer_handshakes_total", {"peer": "drone1"}, 3),
        ("peer_transmit_envelopes_total", {"peer": "drone1"}, 10),
        ("peer_receive_envelopes_total", {"peer": "drone1"}, 11),
        ("peer_transmit_bytes_total", {"peer": "drone1"}, 1e12),
        ("peer_receive_bytes_total", {"peer": "drone1"}, 13),
        ("peer_elsewhere_bytes_total", {"peer": "drone1"}, 56),
        ("peer_receive_frames_total", {"peer": "drone1"}, 14),
        ("peer_unsent_copies_total", {"peer": "drone1", "reason": "copy_over_budget"}, 8),
        ("peer_superseded_frames_total", {"peer": "drone1"}, 9),
        ("peer_missing_envelopes_total", {"peer": "drone1"}, 50),
        ("peer_out_of_order_envelopes_total", {"peer": "drone1"}, 51),
        ("peer_unproven_paths_total", {"peer": "drone1"}, 52),
        ("peer_unanswered_echoes_total", {"peer": "drone1"}, 53),
        ("peer_unanswered_handshakes_total", {"peer": "drone1"}, 54),
        ("peer_taken_cookies_total", {"peer": "drone1"}, 55),
        ("peer_malformed_total", {"peer": "drone1", "reason": "bad_crc"}, 15),
        ("peer_unsent_frames_total", {"peer": "drone1", "reason": "stale"}, 16),
        ("rx_dropped_total", {"peer": "drone1", "reason": "bad_tag"}, 17),
        ("rx_dropped_total", {"peer": "", "reason": "malformed"}, 30),
        ("peer_refused_frames_total", {"peer": "drone1", "direction": "in", "reason": "message_not_allowed"}, 3),
        ("peer_refused_frames_total", {"peer": "drone1", "direction": "in", "reason": "rate_limited"}, 4),
        ("endpoint_clients", {"endpoint": "autopilot"}, 2),
        ("endpoint_receive_frames_total", {"endpoint": "autopilot"}, 20),
        ("endpoint_transmit_frames_total", {"endpoint": "autopilot"}, 21),
        ("endpoint_receive_bytes_total", {"endpoint": "autopilot"}, 22),
        ("endpoint_transmit_bytes_total", {"endpoint": "autopilot"}, 23),
        ("endpoint_garbage_bytes_total", {"endpoint": "autopilot"}, 24),
        ("endpoint_malformed_total", {"endpoint": "autopilot", "reason": "not_mavlink"}, 25),
        ("endpoint_failures_total", {"endpoint": "autopilot", "reason": "ECONNREFUSED"}, 26),
        (
            "endpoint_refused_frames_total",
            {"endpoint": "autopilot", "direction": "out", "reason": "setup_signing"},
            27,
        ),
        ("peer_path_state", {**LTE, "state": "usable"}, 1),
        ("peer_path_state", {**LTE, "state": "down"}, 0),
        ("peer_path_state", {**OTHER, "state": "down"}, 1),
        ("peer_path_best", LTE, 1),
        ("peer_path_best", OTHER, 0),
        ("peer_path_carries", {**LTE, "class": "bulk"}, 1),
        ("peer_path_carries", {**OTHER, "class": "critical"}, 1),
        ("peer_path_carries", {**OTHER, "class": "stream"}, 0),
        ("peer_path_loss_ratio", {**LTE, "direction": "in"}, 0.25),
        ("peer_path_loss_ratio", {**LTE, "direction": "out"}, 0.75),
        ("peer_path_round_trip_seconds", LTE, 0.06),
        ("peer_path_jitter_seconds", LTE, 0.004),
        ("peer_path_lag_seconds", LTE, 0.0),
        ("peer_path_receive_bytes_total", LTE, 61),
        ("peer_path_transmit_bytes_total", LTE, 62),
        ("peer_path_receive_datagrams_total", LTE, 63),
        ("peer_path_transmit_datagrams_total", OTHER, 64),
        ("peer_path_duplicates_total", OTHER, 65),
        ("line_open", SIK, 1),
        ("line_open", {"network": "quiet"}, 0),
        ("line_uses_cts", SIK, 1),
        ("line_uses_cts", {"network": "quiet"}, 0),
        ("line_rate_bytes_per_second", SIK, 1200),
        ("line_cts_held_seconds_total", SIK, 1.5),
        ("line_discarded_total", {**SIK, "reason": "bad_crc"}, 70),
        ("line_discarded_total", {**SIK, "reason": "too_long"}, 0),
        ("line_discarded_bytes_total", {**SIK, "reason": "bad_crc"}, 71),
        ("line_receive_datagrams_total", SIK, 72),
        ("line_receive_bytes_total", SIK, 73),
        ("line_transmit_bytes_total", SIK, 74),
        ("line_failures_total", {**SIK, "reason": "LINE_FULL"}, 75),
        ("line_radio_reports_total", SIK, 76),
        ("line_radio_rssi", {**SIK, "end": "here"}, 200),
        ("line_radio_noise", {**SIK, "end": "here"}, 50),
        ("line_radio_noise", {**SIK, "end": "there"}, 51),
        ("line_radio_free_buffer_ratio", SIK, 0.98),
        ("line_radio_receive_errors_total", SIK, 77),
        ("line_radio_corrected_total", SIK, 78),
        ("unrouted_frames_total", {"reason": "unknown_target"}, 31),
        ("send_failures_total", {"reason": "ENETUNREACH"}, 32),
        ("stale_frames_total", {"source": "autopilot"}, 33),
        ("recording_up", {}, 1),
        ("recording_frames_total", {}, 40),
        ("recording_bytes_total", {}, 41),
        ("recording_lost_frames_total", {}, 42),
        ("recording_failures_total", {"reason": "ENOSPC"}, 43),
    ],
)
def test_number_of_the_status_is_exported(name: str, labels: dict[str, str], expected: float) -> None:
    """The value is unchanged, under its metric name and labels."""
    assert value(name, **labels) == expected


def test_learned_address_is_not_a_label() -> None:
    """An attacker can cause learned paths with any address: the number of series must not grow with them."""
    text = exposition(STATUS, 0.0)
    assert LEARNED_PATH["address"].encode() not in text
    assert ("uavlinkd_peer_path_round_trip_seconds", frozenset(OTHER.items())) not in samples(text)


def test_silent_modem_and_unknown_figures_have_no_samples() -> None:
    """A modem that reports nothing has no figures; 255 means that the modem does not know one. UDP has no line."""
    lines = [(name, dict(labels)) for name, labels in samples(exposition(STATUS, 0.0)) if "uavlinkd_line_" in name]
    radio = {(name, labels["network"]) for name, labels in lines if "radio" in name and "reports" not in name}
    assert {network for _, network in radio} == {"sik"}
    assert ("uavlinkd_line_radio_rssi", {"network": "sik", "end": "there"}) not in lines
    assert {labels["network"] for _, labels in lines} == {"sik", "quiet"}


def test_version_is_exported() -> None:
    """The version is a label, which a query can join with other metrics."""
    assert f'version="{__version__}"'.encode() in exposition(STATUS, 0.0)


def test_process_is_measured() -> None:
    """CPU time and memory of the daemon are exported."""
    assert value("cpu_seconds_total") > 0
    assert value("resident_memory_bytes") > 1_000_000


def test_prometheus_accepts_the_format() -> None:
    """The checker of Prometheus accepts format and names without a remark."""
    promtool = shutil.which("promtool")
    need(promtool is not None, "promtool, of Debian's package prometheus")
    done = subprocess.run(
        [str(promtool), "check", "metrics"], input=exposition(STATUS, 1.0), capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_counters_of_attacks_start_at_zero() -> None:
    """Every reason exists for every peer, so Prometheus sees the first increase."""
    values = samples(exposition(STATUS, 0.0))
    for peer in ("", "drone1", "drone2"):
        drops = {labels for name, labels in values if ("peer", peer) in labels and "rx_dropped" in name}
        reasons = {dict(labels)["reason"] for labels in drops}
        assert reasons == set(DropReason)
    for kind, part in (("peer", "drone1"), ("endpoint", "autopilot")):
        reasons = {
            dict(labels)["reason"]
            for name, labels in values
            if (kind, part) in labels and ("direction", "in") in labels and name.endswith("refused_frames_total")
        }
        assert reasons == set(Refusal)


def test_unknown_values_have_no_sample() -> None:
    """A peer that was never up has no ages; a daemon without recording has no recording metrics."""
    names = {name for name, labels in samples(exposition(STATUS, 0.0)) if ("peer", "drone2") in labels}
    assert not names & {
        "uavlinkd_round_trip_seconds",
        "uavlinkd_path_loss_ratio",
        "uavlinkd_peer_info",
        "uavlinkd_peer_last_handshake_age_seconds",
        "uavlinkd_peer_last_received_age_seconds",
    }
    status = copy.deepcopy(STATUS) | {"recording": None}
    assert b"recording" not in exposition(status, 0.0)


def test_unverified_freshness_is_one() -> None:
    """The metric is a flag, whatever the duration."""
    status = STATUS | {"peers": {"drone1": PEER | {"freshness_unverified_s": 12.5}}}
    key = "uavlinkd_peer_freshness_unverified", frozenset({("peer", "drone1")})
    assert samples(exposition(status, 0.0))[key] == 1


def test_names_with_special_characters_are_escaped() -> None:
    """The configuration refuses such names, but the format must not depend on that."""
    status = STATUS | {"peers": {'a"} 1\nb\\': PEER}}
    (values,) = [dict(labels) for name, labels in samples(exposition(status, 0.0)) if name == "uavlinkd_peer_up"]
    assert values == {"peer": r"a\"} 1\nb\\"}


def test_daemon_without_metrics_does_not_load_the_library() -> None:
    """Its start time and memory do not pay for `prometheus_client`."""
    script = "import sys, uavlinkd.link.daemon; sys.exit('prometheus_client' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
