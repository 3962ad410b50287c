"""``uavlinkd netcheck``: what it prints of each relay."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.test_readmes import ROOT
from uavlinkd.ops.netcheck import report
from uavlinkd.system.error_meanings import WEB_ERRORS

PATH = {"network": "lte", "address": "198.51.100.2:5790", "is_configured": True, "state": "usable"}
SILENT = PATH | {"state": "down"}
RELAY = {"state": "up", "round_trip_s": 0.0234, "paths": [PATH], "seen_as": []}


def answer(**relay: Any) -> dict[str, Any]:
    """A daemon's answer about one relay."""
    return {"relays": {"vps": RELAY | relay}, "web": {}}


@pytest.mark.parametrize(
    ("relay", "lines", "is_complete"),
    [
        ({}, ["UDP          vps: answers, 23 ms"], True),
        ({"round_trip_s": None}, ["UDP          vps: answers"], True),
        (
            {"paths": [PATH, SILENT]},
            ["UDP          vps: answers, 23 ms", "             no answer at 198.51.100.2:5790"],
            False,
        ),
        ({"paths": [PATH | {"network": "TLS"}]}, ["UDP          vps: does not answer; it does by TLS"], False),
        (
            {"state": "waiting", "paths": [SILENT]},
            ["UDP          vps: does not answer", "             no answer at 198.51.100.2:5790"],
            False,
        ),
        (
            {"seen_as": ["203.0.113.7:40001"]},
            ["UDP          vps: answers, 23 ms", "seen as      203.0.113.7:40001 by vps"],
            True,
        ),
    ],
)
def test_each_relay_has_its_lines(relay: dict[str, Any], lines: list[str], is_complete: bool) -> None:
    """A hint at `status` follows where something does not answer."""
    printed = list(report(answer(**relay)))
    assert printed[: len(lines)] == lines
    assert (printed == lines) is is_complete
    assert is_complete or "`uavlinkd status`" in printed[-1]


def test_without_relays_it_names_what_to_do() -> None:
    (line,) = report({"relays": {}, "web": {}})
    assert "no [[relay]]" in line


@pytest.mark.parametrize(
    ("error", "line"),
    [
        ("", "connects"),
        ("http_404", "a web server answers there, but not for this path"),
        ("http_403", "a web server, proxy or login page there refuses (http_403): log in to this network"),
        ("tls", "no TLS at this port, or a firewall that inspects TLS ends it (tls): compare the URL"),
        ("proxy_407", "the proxy wants a name and password (proxy_407): write HTTPS_PROXY=http://USER"),
        ("proxy_403", "the proxy refuses to connect to the relay (proxy_403): its owner"),
        ("ECONNREFUSED", "no process listens there now (ECONNREFUSED): start it, or correct the port"),
    ],
)
def test_each_url_of_a_relay_is_tried(error: str, line: str) -> None:
    web = {"wss://one:443/uavlink": {"error": error, "proxy": "10.0.0.1:3128" if error == "proxy_407" else ""}}
    lines = list(report({**answer(), "web": web}))
    (found,) = [text for text in lines if text.startswith("TLS ")]
    through = " through the proxy 10.0.0.1:3128" if error == "proxy_407" else ""
    assert found.startswith(f"TLS          wss://one:443/uavlink{through}: {line}")


def test_reasons_by_tls_are_a_closed_list() -> None:
    """Each reason of a member has a meaning and a remedy, which ``status`` shows too, and a row in README.md."""
    sources = [ROOT / "uavlinkd/tls" / f"{name}.py" for name in ("connect", "stream", "channel")]
    written = r'(?:lose\(|lose, |return |fault = |else |WebConnectError\()f?"([a-z0-9_]+)'
    reasons = {reason for path in sources for reason in re.findall(written, path.read_text())}
    of_relays, of_daemon = {"page", "wrong_path"}, {"finished"}
    elsewhere = {"http_404", "proxy_407", "TimeoutError", "silent", "ECONNRESET", "EPIPE", "ETIMEDOUT"}
    assert reasons - of_relays - of_daemon | elsewhere == set(WEB_ERRORS)
    assert all(": " in meaning for meaning in WEB_ERRORS.values())
    table = (ROOT / "uavlinkd/ops/README.md").read_text().partition("| reason | meaning | remedy |")[2]
    rows = [line.split(" | ")[0] for line in table.partition("\n\n")[0].splitlines()]
    names = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert names - {"ECONNREFUSED"} == set(WEB_ERRORS)
