"""The screen of `uavlinkd status`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import pytest
from rich.console import Console, RenderableType

from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import FrameFault
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.findings import Finding, Severity, Subject
from uavlinkd.ops.link_problems import LinkProblem
from uavlinkd.ops.reason_phrases import (
    DATAGRAMS,
    ENDPOINT_FAILURES,
    FAULTS,
    LINK_PROBLEMS,
    QUEUED,
    REFUSALS,
    phrase,
)
from uavlinkd.ops.status_screen import render_peers, render_status


def peer(state: str, **facts: object) -> dict[str, Any]:
    """The status of a peer."""
    return {
        "state": state,
        "last_received_s": 12.3,
        "round_trip_s": 0.1234,
        "freshness_unverified_s": None,
        "loss_in": 0.12,
        "loss_out": 1.0,
        "bytes_in_s": 123456.0,
        "bytes_out_s": 123456.0,
        "path": "203.0.113.255:65535",
        "session": {"suite": "x25519-mlkem768", "mode": "authenticated"},
        "handshake_s": 99.9,
        "drops": {},
        "malformed": {},
        "waiting_dropped": {},
        "refused": {},
        "refused_commands": {"in": {}, "out": {}},
        "role": None,
        **dict.fromkeys(LinkProblem, 0),
        **facts,
    }


def status_of(peers: dict[str, dict[str, Any]], **facts: object) -> dict[str, Any]:
    """A status with these peers."""
    return {
        "name": "drone0",
        "frames_pass": all(peer["state"] == "up" for peer in peers.values()),
        "blocked": [],
        "findings": [],
        "peers": peers,
        "endpoints": {},
        "drops": {},
        "send_failures": {},
        "stale": {},
        "recording": None,
        **facts,
    }


def printed(screen: RenderableType, width: int) -> str:
    """The text of a screen without colours."""
    file = io.StringIO()
    Console(file=file, width=width).print(screen)
    return file.getvalue()


def shown(peers: dict[str, dict[str, Any]], width: int, **facts: object) -> str:
    """The text of the screen."""
    return printed(render_status(status_of(peers, **facts)), width)


def words(text: str) -> str:
    """The text without line breaks."""
    return " ".join(text.split())


def finding(name: str, severity: Severity = Severity.FAULT, subject: Subject = Subject.PEER, n: int = 0) -> Any:
    """A finding as the status has it."""
    text, remedy = (
        f"the response from 10.13.0.{n} does not authenticate: the PSKs differ",
        "give both the same psk_file",
    )
    return Finding("wrong_psk", severity, subject, name, text, remedy).as_json()


@pytest.mark.parametrize("name", ["drone1", "ground-station"])
def test_screen_fits_eighty_columns(name: str) -> None:
    """On the narrowest terminal, and in a pipe, no number and no reason is cut."""
    drops = {"replayed": 1234567, "bad_tag": 12, "late": 1}
    text = shown({name: peer("waiting", drops=drops)}, 80)
    assert max(map(len, text.splitlines())) <= 80
    assert "\u2026" not in text
    path = "203.0.113.255:65535"
    for part in (
        name,
        "waiting",
        "12.3 s",
        "123.4 ms",
        "12/100 %",
        "123.5 kB/s",
        path,
        "x25519-mlkem768",
        "99.9 s",
    ):
        assert part in text
    dropped = "1,234,567 replayed or duplicated, 12 altered or forged, 1 of an ended session"
    assert f"{name} dropped: {dropped}" in words(text)


@pytest.mark.parametrize("path", ["[fd00::2]:5790", "[fe80::1%2]:5790", "[2001:db8:a::1]:5790"])
def test_ipv6_address_is_not_markup(path: str) -> None:
    """Brackets and colons are printed unchanged."""
    assert path in shown({"drone1": peer("up", path=path)}, 80)


def test_hidden_frame_is_shown_before_reasons_with_greater_counts() -> None:
    """A captured member cannot remove it from the screen with other refused frames."""
    loud = {"foreign_system": 900, "message_not_allowed": 800, "rate_limited": 700}
    refused = {"in": {"HEARTBEAT": loud, "HOME_POSITION": {"hidden_frame": 1}}}
    text = " ".join(shown({"drone1": peer("up", refused=refused)}, 80).split())
    hidden, foreign = "1 that hide a forbidden frame", "900 from a system not in system_ids"
    assert f"drone1 dropped: {hidden}, {foreign}, 800 not allowed by role or lists, \u2026" in text


def test_problems_come_first_with_cause_and_remedy() -> None:
    """Security is above the faults, in capitals and red; then the tables. Each line fits into 80 columns."""
    findings = [finding("zulu", Severity.SECURITY), finding("drone1"), finding("autopilot", subject=Subject.ENDPOINT)]
    screen = render_status(status_of({"drone1": peer("waiting")}, findings=findings))
    text = printed(screen, 80)
    assert max(map(len, text.splitlines())) <= 80
    whole = words(text)
    for label in ("SECURITY zulu: ", "fault drone1: ", "fault endpoint autopilot: "):
        assert f"{label}the response from 10.13.0.0 does not authenticate" in whole
    assert whole.count("Remedy: give both the same psk_file") == 3
    assert whole.index("SECURITY") < whole.index("fault drone1") < whole.index("silent rtt")
    file = io.StringIO()
    Console(file=file, width=80, force_terminal=True, color_system="standard").print(screen)
    assert "\x1b[1;31mSECURITY\x1b[0m" in file.getvalue()
    assert "\x1b[1;31mfault" not in file.getvalue()


def test_everyday_problems_do_not_push_out_security() -> None:
    """All security lines are shown, and of the others as many as fit; the rest is counted."""
    security = [finding(f"s{n}", Severity.SECURITY, n=n) for n in range(30)]
    text = words(shown({"drone1": peer("up")}, 80, findings=[*security, *(finding(f"f{n}") for n in range(25))]))
    assert text.count("SECURITY") == 30
    assert text.count("fault ") == 20
    assert "and 5 more: `uavlinkd status --json` has all of them" in text


def test_codes_are_in_json_only() -> None:
    """Every reason of every closed list is shown in plain words, and none of them twice in a list."""
    lists: list[tuple[type[StrEnum], Mapping[str, str]]] = [
        (DropReason, DATAGRAMS),
        (Refusal, REFUSALS),
        (FrameFault, FAULTS),
        (EgressDrop, QUEUED),
    ]
    for members, table in lists:
        assert set(table) == set(members)
    assert set(LINK_PROBLEMS) == set(LinkProblem) - {LinkProblem.ENVELOPES_MISSING}
    for table in (DATAGRAMS, REFUSALS, FAULTS, QUEUED, LINK_PROBLEMS, ENDPOINT_FAILURES):
        assert len(set(table.values())) == len(table)
        assert all(
            len(text) <= 45 and "_" not in text.replace("system_ids", "").replace("SETUP_SIGNING", "")
            for text in table.values()
        )
    assert phrase("ECONNREFUSED", ENDPOINT_FAILURES) == "connection refused"


def test_refused_datagrams_are_explained() -> None:
    """The screen has the meaning of the kernel's error."""
    text = words(shown({"drone1": peer("up")}, 80, send_failures={"EPERM": 67}, drops={"bad_mac1": 3}))
    assert "not sent: 67, because this machine's firewall" in text
    assert "from no known peer: 3 handshakes for another key than this daemon's" in text


def test_broken_links_come_first() -> None:
    """The operator looks for them, also in the list of keys, which has their causes."""
    peers = {"alpha": peer("up", public_key="A="), "zulu": peer("lost", public_key="Z=")}
    text = shown(peers, 100)
    assert text.index("zulu") < text.index("alpha")
    assert "1 of 2 peers up" in text
    listed = printed(render_peers(status_of(peers, findings=[finding("zulu")])), 100)
    assert listed.index("zulu") < listed.index("alpha") < listed.index("fault")


def test_blocked_traffic_is_in_the_headline() -> None:
    """The link is up, but frames do not pass."""
    blocked = [{"subject": "peer", "name": "drone1", "direction": "in"}]
    text = shown({"drone1": peer("up")}, 80, blocked=blocked, frames_pass=False)
    assert "1 of 1 peers up, all frames from drone1 are refused" in words(text)


def test_healthy_screen_is_short() -> None:
    """One peer, one endpoint: the headline and two rows for each table of peers, one for endpoints."""
    endpoint = {
        "clients": {"127.0.0.1:52159": {"last_received_s": 0.0}},
        "frames_received": 350,
        "frames_sent": 277,
        "faults": {},
        "failures": {},
        "refused": {},
    }
    text = shown({"drone1": peer("up")}, 80, endpoints={"autopilot": endpoint})
    assert len(text.strip().splitlines()) <= 15
