"""``uavlinkd netcheck``: what it prints of each relay."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.test_readmes import ROOT
from uavlinkd.ops.netcheck import folded, report
from uavlinkd.system.error_meanings import WEB_ERRORS

RELAY = {"state": "up", "is_udp": True, "round_trip_s": 0.0234, "silent": [], "unresolved": [], "views": []}
AT = "[2001:db8:1111:2222:3333:4444:5555:6666]:40001"


def answer(**relay: Any) -> dict[str, Any]:
    """A daemon's answer about one relay."""
    return {"relays": {"vps": RELAY | relay}, "web": {}, "is_relay": False}


@pytest.mark.parametrize(
    ("relay", "lines"),
    [
        ({}, ["UDP          vps: answers, 23 ms"]),
        ({"round_trip_s": None}, ["UDP          vps: answers"]),
        (
            {"silent": ["198.51.100.2:5791"]},
            ["UDP          vps: answers, 23 ms", "             no answer at 198.51.100.2:5791"],
        ),
        ({"is_udp": False}, ["UDP          vps: does not answer; it does by TLS"]),
        (
            {"is_udp": False, "state": "waiting", "silent": ["198.51.100.2:5790"]},
            ["UDP          vps: does not answer", "             no answer at 198.51.100.2:5790"],
        ),
        (
            {"is_udp": False, "state": "waiting", "unresolved": ["vps.example.org"]},
            ["UDP          vps: vps.example.org has no address now: see `getent hosts vps.example.org`"],
        ),
        (
            {"views": [{"seen_as": "203.0.113.7:40001", "relay_address": "198.51.100.2:5790", "network": "lte"}]},
            [
                "UDP          vps: answers, 23 ms",
                "seen as      203.0.113.7:40001 by vps at 198.51.100.2:5790 on lte",
            ],
        ),
    ],
)
def test_each_relay_has_its_lines(relay: dict[str, Any], lines: list[str]) -> None:
    """A hint at `status` follows where something does not answer."""
    printed = list(report(answer(**relay)))
    assert printed[: len(lines)] == lines
    is_complete = printed == lines
    assert is_complete is not ("silent" in relay or not relay.get("is_udp", True))
    assert is_complete or "`uavlinkd status`" in printed[-1]


@pytest.mark.parametrize(("is_relay", "count"), [(False, 1), (True, 2)])
def test_without_relays_it_names_what_to_do(*, is_relay: bool, count: int) -> None:
    lines = list(report({"relays": {}, "web": {}, "is_relay": is_relay}))
    assert "no [[relay]]" in lines[0]
    assert len(lines) == count


def test_report_fits_80_columns() -> None:
    """Addresses stay whole, and folded lines begin below the text."""
    lines = list(report(answer(views=[{"seen_as": AT, "relay_address": AT, "network": "lte"}])))
    printed = [line for text in lines for line in folded(text).splitlines()]
    assert max(map(len, printed)) <= 80
    assert " ".join(" ".join(printed).split()) == " ".join(" ".join(lines).split())
    assert any(line.startswith(" " * 13) and AT in line for line in printed)


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
