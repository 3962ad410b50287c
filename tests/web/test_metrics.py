"""The metrics: each number of the status under its name and labels, in a format that Prometheus accepts."""

from __future__ import annotations

import re
import shutil
import subprocess
from itertools import count
from pathlib import Path
from typing import Any

from tests.needs import need
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.protocol.drops import DropReason
from uavlinkd.web import metrics
from uavlinkd.web.metrics import exposition

_NUMBERS = count(1000)


def numbered(*names: str) -> dict[str, Any]:
    """Another number for each of the names."""
    return {name: next(_NUMBERS) for name in names}


PATH: dict[str, Any] = {
    "number": 1,
    "network": "lte",
    "address": "203.0.113.7:5790",
    "is_configured": True,
    "state": "usable",
    "role": "best",
    "carries": ["critical", "stream", "bulk"],
    **numbered("round_trip_s", "jitter_s", "loss_in", "loss_out", "bytes_received", "bytes_sent"),
    **numbered("datagrams_received", "datagrams_sent", "duplicates"),
}
LEARNED_PATH = {
    **PATH,
    **dict.fromkeys(("network", "round_trip_s", "jitter_s")),
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
    "freshness_unverified_s": None,
    "session": {"suite": "x25519", "mode": "authenticated", "tag_bits": 128},
    **numbered("handshake_s", "last_received_s", "round_trip_s", "loss_in", "loss_out", "handshakes"),
    **numbered("envelopes_sent", "envelopes_received", "bytes_sent", "bytes_received", "bytes_elsewhere"),
    **numbered("envelopes_missing", "envelopes_out_of_order", "paths_unproven", "echoes_unanswered"),
    **numbered("handshakes_unanswered", "cookies_taken", "frames_received", "frames_superseded"),
    "malformed": numbered("bad_crc"),
    "waiting_dropped": numbered("stale"),
    "copies_dropped": numbered("copy_over_budget"),
    "drops": numbered("bad_tag"),
    "problems_there": ["no_client", "problem_200"],
    "repair": {"is_on": True, "on_s": 3.0, **numbered("transmissions", "datagrams", "bytes")},
    "refused": {
        "in": {
            "PING": {"message_not_allowed": 1},
            "PARAM_SET": {"message_not_allowed": 2, **numbered("rate_limited")},
        },
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
LINE: dict[str, Any] = {
    "rate_bits_s": 9600,
    "discarded": numbered("bad_crc", "too_long"),
    "discarded_bytes": numbered("bad_crc", "too_long"),
    "failures": numbered("LINE_FULL"),
    **numbered("datagrams_received", "bytes_received", "bytes_written", "reports"),
    "radio": {"remrssi": 255, "txbuf": 98, **numbered("rssi", "noise", "remnoise", "rxerrors", "fixed")},
}
MEMBER = numbered("bound", "waiting", "binds_ignored", "datagrams", "bytes", "over_limit")
ENDPOINT = {
    "clients": {"127.0.0.1:14550": {}, "127.0.0.1:14551": {}},
    **numbered("frames_received", "frames_sent", "bytes_received", "bytes_sent", "garbage_bytes"),
    "faults": numbered("not_mavlink"),
    "failures": numbered("ECONNREFUSED"),
    "refused": {"in": {}, "out": {"PING": numbered("setup_signing")}},
}
STATUS: dict[str, Any] = {
    "fleet": {"held": {"v1": 3}, "problem": "", **numbered("number")},
    "relay": {
        **numbered("connections"),
        "dropped": numbered("relay_over_limit"),
        "https": {
            **numbered("connections", "strangers"),
            "refused": numbered("displaced", "tls"),
            "lost": numbered("closed"),
        },
        "members": {"drone1": {"is_up": True, **MEMBER}},
    },
    "name": "drone0",
    "schema": 3,
    "process": {"version": "0.1.0", "python": "3.13.5", "log_schema": 2}
    | numbered("uptime_s", "cpu_s", "resident_bytes"),
    "networks": {
        "lte": {"is_present": True, "serial": None},
        "sik": {"is_present": True, "serial": LINE},
        "quiet": {"is_present": False, "serial": {**LINE, "radio": None}},
    },
    "frames_pass": False,
    "findings": [FINDING, FINDING | {"text": "other evidence of the same"}],
    "peers": {"drone1": PEER, "drone2": NEVER_UP},
    "endpoints": {"autopilot": ENDPOINT},
    "relays": {
        "vps": {
            "state": "up",
            "peers": {"drone1": "bound", "drone2": "waiting"},
            **numbered("round_trip_s", "bytes_received", "bytes_sent"),
        }
    },
    "drops": numbered("malformed"),
    "unrouted": numbered("unknown_target"),
    "send_failures": numbered("ENETUNREACH"),
    "stale": numbered("autopilot"),
}
ALL_NUMBERS = set(range(1000, next(_NUMBERS)))

_SAMPLE = re.compile(r"uavlinkd_(\w+(?:\{.*\})?) (\S+)")


def samples(status: dict[str, Any] = STATUS) -> dict[str, float]:
    """Values by name and labels; each pair occurs once."""
    lines = [line for line in exposition(status).decode().splitlines() if not line.startswith("#")]
    matches = [match for line in lines if (match := _SAMPLE.fullmatch(line)) is not None]
    values = {match[1]: float(match[2]) for match in matches}
    assert len(values) == len(lines)
    return values


def test_every_number_of_the_status_is_exported() -> None:
    """Once by its metric. Only the time since when repair is on is in the status alone."""
    exported = samples()
    assert set(exported.values()) >= ALL_NUMBERS
    for rows in (part["metrics"] for part in metrics._METRICS):
        assert len({key for _, key, *_ in rows}) == len(rows)
        for name, key, *_ in rows:  # Prometheus's words, and those of the status
            assert ("receive_" in name) is ("received" in key and "last" not in key) or "radio" in name, name
            assert ("transmit_" in name) is ("sent" in key or "written" in key), name


def promtool(*arguments: str | Path, given: str = "") -> tuple[str, str]:
    """Output and errors of Prometheus's tool, which must succeed."""
    path = shutil.which("promtool")
    need(path is not None, "promtool, of Debian's package prometheus")
    command = [str(path), *map(str, arguments)]
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, done.stderr


def test_learned_address_is_not_a_label() -> None:
    """An attacker can cause learned paths with any address: the number of series must not grow with them."""
    assert not any(str(LEARNED_PATH["address"]) in name for name in samples())


def test_unknown_values_have_no_sample() -> None:
    """Of a peer that was never up, a path without answer, a modem that is silent or does not know a figure, UDP."""
    names = set(samples())
    timed = ("round_trip_seconds", "path_loss_ratio", "peer_info", "peer_last")
    assert not any('peer="drone2"' in name and name.startswith(timed) for name in names)
    assert not any('path="2"' in name for name in names if name.startswith("peer_path_round_trip"))
    assert 'line_radio_rssi{end="there",network="sik"}' not in names
    assert not any('="quiet"' in name and "line_radio_r" in name and "reports" not in name for name in names)
    assert not any('network="lte"' in name for name in names if name.startswith("line_"))
    bare = samples(STATUS | {"relay": None})
    assert not any(name.startswith("relay_") for name in bare)


def test_prometheus_accepts_the_format() -> None:
    """The checker of Prometheus accepts format and names without a remark."""
    assert promtool("check", "metrics", given=exposition(STATUS).decode()) == ("", "")


def test_counters_of_attacks_start_at_zero() -> None:
    """Every reason exists for every peer, so Prometheus sees the first increase."""
    names = samples()
    for peer in ("", "drone1", "drone2"):
        assert all(f'rx_dropped_total{{peer="{peer}",reason="{reason}"}}' in names for reason in DropReason)
    for kind, name in ("peer", "drone1"), ("endpoint", "autopilot"):
        part = f'{kind}_refused_frames_total{{direction="in",{kind}="{name}"'
        assert all(f'{part},reason="{reason}"}}' in names for reason in Refusal)
