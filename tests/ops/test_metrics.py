"""The text that Prometheus reads: by its own checker, with every number where the status has it."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
from typing import Any

import pytest

from tests.daemon.harness import need
from uavlinkd import __version__
from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.metrics import exposition

PEER: dict[str, Any] = {
    "state": "up",
    "session": {"suite": "x25519", "mode": "authenticated", "tag_bits": 128},
    "handshake_s": 12.5,
    "heard_s": 0.25,
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
    "challenges_unanswered": 52,
    "echoes_unanswered": 53,
    "handshakes_unanswered": 54,
    "cookies_taken": 55,
    "frames_received": 14,
    "malformed": {"bad_crc": 15},
    "waiting_dropped": {"stale": 16},
    "drops": {"bad_tag": 17},
    "refused": {
        "in": {"PING": {"message_not_allowed": 1}, "PARAM_SET": {"message_not_allowed": 2, "rate_limited": 4}},
        "out": {},
    },
}
NEVER_UP = {**PEER, "state": "waiting", "session": None, "handshake_s": None, "heard_s": None, "round_trip_s": None}
STATUS: dict[str, Any] = {
    "name": "drone0",
    "peers": {"drone1": PEER, "drone2": NEVER_UP},
    "endpoints": {
        "autopilot": {
            "programs": {"127.0.0.1:14550": {}, "127.0.0.1:14551": {}},
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
    "drops": {"malformed": 30},
    "unrouted": {"unknown_target": 31},
    "send_failures": {"ENETUNREACH": 32},
    "stale": {"autopilot": 33},
    "recording": {"is_recording": True, "frames": 40, "bytes": 41, "frames_lost": 42, "failures": {"ENOSPC": 43}},
}

_SAMPLE = re.compile(r"(\w+)(?:\{(.*)\})? (\S+)")
_LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"(?:,|$)')


def samples(text: bytes) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Values by name and labels; each is there once."""
    found: dict[tuple[str, frozenset[tuple[str, str]]], float] = {}
    for line in text.decode().splitlines():
        if line.startswith("#"):
            continue
        match = _SAMPLE.fullmatch(line)
        assert match is not None, line
        labels = match[2] or ""
        assert _LABEL.sub("", labels) == "", line
        key = (match[1], frozenset(_LABEL.findall(labels)))
        assert key not in found, line
        found[key] = float(match[3])
    return found


def value(name: str, **labels: str) -> float:
    """One sample of the status above."""
    return samples(exposition(STATUS, 5.0))[f"uavlinkd_{name}", frozenset(labels.items())]


@pytest.mark.parametrize(
    ("name", "labels", "expected"),
    [
        ("uptime_seconds", {}, 5.0),
        ("peer_up", {"peer": "drone1"}, 1),
        ("peer_up", {"peer": "drone2"}, 0),
        ("peer_info", {"peer": "drone1", "suite": "x25519", "mode": "authenticated", "tag_bits": "128"}, 1),
        ("path_loss_ratio", {"peer": "drone1", "direction": "in"}, 0.125),
        ("path_loss_ratio", {"peer": "drone1", "direction": "out"}, 0.5),
        ("peer_last_handshake_age_seconds", {"peer": "drone1"}, 12.5),
        ("peer_last_heard_age_seconds", {"peer": "drone1"}, 0.25),
        ("round_trip_seconds", {"peer": "drone1"}, 0.003),
        ("peer_freshness_unverified", {"peer": "drone1"}, 0),
        ("peer_handshakes_total", {"peer": "drone1"}, 3),
        ("peer_transmit_envelopes_total", {"peer": "drone1"}, 10),
        ("peer_receive_envelopes_total", {"peer": "drone1"}, 11),
        ("peer_transmit_bytes_total", {"peer": "drone1"}, 1e12),
        ("peer_receive_bytes_total", {"peer": "drone1"}, 13),
        ("peer_elsewhere_bytes_total", {"peer": "drone1"}, 56),
        ("peer_receive_frames_total", {"peer": "drone1"}, 14),
        ("peer_missing_envelopes_total", {"peer": "drone1"}, 50),
        ("peer_out_of_order_envelopes_total", {"peer": "drone1"}, 51),
        ("peer_unanswered_challenges_total", {"peer": "drone1"}, 52),
        ("peer_unanswered_echoes_total", {"peer": "drone1"}, 53),
        ("peer_unanswered_handshakes_total", {"peer": "drone1"}, 54),
        ("peer_taken_cookies_total", {"peer": "drone1"}, 55),
        ("peer_malformed_total", {"peer": "drone1", "reason": "bad_crc"}, 15),
        ("peer_unsent_frames_total", {"peer": "drone1", "reason": "stale"}, 16),
        ("rx_dropped_total", {"peer": "drone1", "reason": "bad_tag"}, 17),
        ("rx_dropped_total", {"peer": "", "reason": "malformed"}, 30),
        ("peer_refused_frames_total", {"peer": "drone1", "direction": "in", "reason": "message_not_allowed"}, 3),
        ("peer_refused_frames_total", {"peer": "drone1", "direction": "in", "reason": "rate_limited"}, 4),
        ("endpoint_programs", {"endpoint": "autopilot"}, 2),
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
def test_number_of_the_status_is_told(name: str, labels: dict[str, str], expected: float) -> None:
    """Exactly, under its name and labels."""
    assert value(name, **labels) == expected


def test_version_is_told() -> None:
    """As a label, for joining."""
    assert f'version="{__version__}"'.encode() in exposition(STATUS, 0.0)


def test_the_process_is_measured() -> None:
    """Its time and its memory."""
    assert value("cpu_seconds_total") > 0
    assert value("resident_memory_bytes") > 1_000_000


def test_prometheus_finds_nothing_to_say() -> None:
    """Its own checker takes format and names."""
    promtool = shutil.which("promtool")
    need(promtool is not None, "promtool, of Debian's package prometheus")
    done = subprocess.run(
        [str(promtool), "check", "metrics"], input=exposition(STATUS, 1.0), capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_what_tells_of_an_attack_is_there_as_zero() -> None:
    """Every reason, for every peer: an increase is seen from the first."""
    found = samples(exposition(STATUS, 0.0))
    for peer in ("", "drone1", "drone2"):
        told = {dict(labels)["reason"] for name, labels in found if ("peer", peer) in labels and "rx_dropped" in name}
        assert told == set(DropReason)
    for kind, part in (("peer", "drone1"), ("endpoint", "autopilot")):
        told = {
            dict(labels)["reason"]
            for name, labels in found
            if (kind, part) in labels and ("direction", "in") in labels and name.endswith("refused_frames_total")
        }
        assert told == set(Refusal)


def test_nothing_is_made_up() -> None:
    """What is not known of a peer has no sample; without recording there is none of it."""
    names = {name for name, labels in samples(exposition(STATUS, 0.0)) if ("peer", "drone2") in labels}
    assert not names & {
        "uavlinkd_round_trip_seconds",
        "uavlinkd_path_loss_ratio",
        "uavlinkd_peer_info",
        "uavlinkd_peer_last_handshake_age_seconds",
        "uavlinkd_peer_last_heard_age_seconds",
    }
    status = copy.deepcopy(STATUS) | {"recording": None}
    assert b"recording" not in exposition(status, 0.0)


def test_unverified_freshness_is_one() -> None:
    """However long it has lasted."""
    status = STATUS | {"peers": {"drone1": PEER | {"freshness_unverified_s": 12.5}}}
    assert b'uavlinkd_peer_freshness_unverified{peer="drone1"} 1\n' in exposition(status, 0.0)


def test_strange_names_stay_inside_their_quotes() -> None:
    """Names come from the configuration, which allows none of these; the format is kept without leaning on that."""
    status = STATUS | {"peers": {'a"} 1\nb\\': PEER}}
    (found,) = [dict(labels) for name, labels in samples(exposition(status, 0.0)) if name == "uavlinkd_peer_up"]
    assert found == {"peer": r"a\"} 1\nb\\"}
