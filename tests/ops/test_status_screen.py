"""The screen of `uavlinkd status`."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console, RenderableType

from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.ops.status_screen import render_status
from uavlinkd.protocol.drops import LinkProblem
from uavlinkd.protocol.path_state import PathCondition

PATH: dict[str, Any] = {
    "number": 1,
    "network": None,
    "address": "203.0.113.255:65535",
    "relay": None,
    "relay_address": None,
    "is_configured": True,
    "state": "usable",
    "reason": "answered",
    "role": "best",
    "carries": ["critical", "stream", "bulk"],
    "answered_s": 0.1,
    "round_trip_s": 1.2345,
    "jitter_s": 0.5678,
    "loss_in": 0.12,
    "loss_out": 1.0,
    "bytes_in_s": 123456.0,
    "bytes_out_s": 1234.0,
    "bytes_received": 123_456_789,
    "bytes_sent": 1_234_567,
}


def peer(state: str, **facts: object) -> dict[str, Any]:
    """The status of a peer."""
    return {
        "state": state,
        "public_key": f"{state}=",
        "last_received_s": 12.3,
        "round_trip_s": 0.1234,
        "freshness_unverified_s": None,
        "repair": {"is_on": False},
        "loss_in": 0.12,
        "loss_out": 1.0,
        "bytes_in_s": 123456.0,
        "bytes_out_s": 123456.0,
        "path": "203.0.113.255:65535",
        "paths": [PATH],
        "session": {"suite": "x25519-mlkem768", "mode": "authenticated"},
        "handshake_s": 99.9,
        "drops": {},
        "malformed": {},
        "waiting_dropped": {},
        "refused": {},
        "role": None,
        "envelopes_received": 30_000,
        **dict.fromkeys(LinkProblem, 0),
        **facts,
    }


def status_of(peers: dict[str, dict[str, Any]], **facts: object) -> dict[str, Any]:
    """A status with these peers."""
    return {
        "name": "drone0",
        "frames_pass": all(peer["state"] == "up" for peer in peers.values()),
        **{key: [] for key in ("blocked", "contested", "stopped_there", "findings")},
        "has_no_client": False,
        "peers": peers,
        **{key: {} for key in ("endpoints", "networks", "relays", "drops", "send_failures", "stale")},
        "relay": None,
        "fleet": None,
        **facts,
    }


def printed(screen: RenderableType, width: int = 80) -> str:
    """The text of a screen without colours."""
    file = io.StringIO()
    Console(file=file, width=width).print(screen)
    text = file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    return text


def words(screen: RenderableType, width: int = 80) -> str:
    """The text without line breaks."""
    return " ".join(printed(screen, width).split())


def finding(name: str, severity: Severity = Severity.FAULT, subject: Subject = Subject.PEER, n: int = 0) -> Any:
    """A finding as the status has it."""
    text = f"the response from 10.13.0.{n} does not authenticate: the PSKs differ"
    return Finding("wrong_psk", severity, subject, name, text, "give both the same psk_file").as_json()


def refused(**reasons: int) -> dict[str, Any]:
    """Refused frames."""
    return {"refused": {"in": {"HEARTBEAT": reasons, "HOME_POSITION": {"hidden_frame": 1}}}}


LINE = {"device": "/dev/ttyUSB0", "baud": 57600, "rate_bits_s": 9600, "line_noise": 3, "radio": None}
RADIO = {"rssi": 200, "remrssi": 190, "noise": 50, "remnoise": 60, "txbuf": 90}
SERIAL = {"interface": None, "address": None, "is_metered": False, "is_present": True, "addresses": ["serial"]}
FLEET = {
    "fleet": "k7qd2m4x",
    "name": "v1",
    "role": "vehicle",
    "serial": 3,
    "number": 5,
    "bulletins": {"ground": 5, "v2": 4, "v3": None},
    "absent": {"v9": "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE="},
}
USED = {
    "state": "up",
    "peer": None,
    "round_trip_s": 0.0123,
    "peers": {"drone1": "bound", "drone2": "waiting"},
    "paths": [{"network": None}],
}
BY_TLS = {**USED, "paths": [{"network": "TLS"}]}


@pytest.mark.parametrize(
    ("facts", "of_peer", "shown"),
    [
        ({}, {"paths": [{**PATH, "address": "[fe80::1%2]:5790"}]}, "[fe80::1%2]:5790"),  # which is not markup
        (
            {},
            refused(foreign_system=900, message_not_allowed=800, rate_limited=700),
            "dropped: 1 that hide a forbidden frame, 900 from a system not in system_ids, 800 not allowed by role or"
            " lists, \u2026",  # a captured member cannot hide it by greater counts
        ),
        (
            {"networks": {"sik": {**SERIAL, "serial": {**LINE, "radio": RADIO}}}},
            {},
            "rssi 200/190, noise 50/60, modem 10 % full",
        ),
        ({}, {"envelopes_out_of_order": 12}, "overtaken: 12 of 30,000 envelopes, 0.04 % (repair, "),
        ({"has_no_client": True}, {}, "1 of 1 peers up, no endpoint has a client"),
        ({"contested": ["a", "b"]}, {}, "1 of 1 peers up, two machines use one key with a, b"),
        (
            {"stopped_there": [f"d{number}" for number in range(9)]},
            {},
            "1 of 1 peers up, frames stop, as reported by d0, d1, d2, d3, d4, d5, d6, d7 and 1 more",
        ),
        ({"fleet": FLEET}, {}, "1 of 2 peers up fleet k7qd2m4x: vehicle v1, serial 3; bulletin 5, but v2 has 4 "),
        ({"fleet": FLEET}, {}, "v9 waiting silent never - 0/0 0.0/0.0 drone1 up"),
        ({}, {"paths": [{**PATH, "round_trip_s": None, "jitter_s": None}]}, "203.0.113.255:65535 best all - 12/100"),
        ({"relays": {"vps": USED}}, {}, "relay vps: up, 12 ms; drone1 bound, drone2 waiting"),
        ({"relays": {"vps": BY_TLS}}, {}, "relay vps: up by TLS, 12 ms; drone1 bound, drone2 waiting"),
    ],
)
def test_what_is_wrong_is_in_plain_words(facts: dict[str, Any], of_peer: dict[str, Any], shown: str) -> None:
    """What differs from a healthy link is one line."""
    assert shown in words(render_status(status_of({"drone1": peer("up", **of_peer)}, **facts)), 160)


def test_what_is_normal_is_no_drop() -> None:
    """Frames that a policy withholds, frames while the link was down, and copies. A hidden frame is a drop."""
    normal = {
        "refused": {"out": {"VFR_HUD": {"message_not_allowed": 65}}},
        "drops": {"no_session": 7, "duplicate": 9},
    }
    assert "dropped" not in words(render_status(status_of({"drone1": peer("up", **normal)})))
    hidden = {"refused": {"out": {"VFR_HUD": {"message_not_allowed": 65, "hidden_frame": 1}}}}
    text = words(render_status(status_of({"drone1": peer("up", **hidden)})))
    assert "withheld: 65 frames, by its role or lists drone1 dropped: 1 that hide a forbidden frame" in text


def test_problems_come_first_with_cause_and_remedy() -> None:
    """Security is above the faults, in capitals and red; then the tables. A problem of fifty peers is one line."""
    findings = [finding("zulu", Severity.SECURITY), finding("autopilot", subject=Subject.ENDPOINT)]
    findings[1:1] = [finding(f"drone{number}") for number in range(1, 51)]
    screen = render_status(status_of({"drone1": peer("waiting")}, findings=findings))
    text = words(screen)
    for label in ("SECURITY zulu: ", "drone8 and 42 more: ", "fault endpoint autopilot: "):
        assert f"{label}the response from 10.13.0.0 does not authenticate" in text
    assert text.count("Remedy: give both the same psk_file") == 3
    assert text.index("SECURITY") < text.index("fault drone1, drone2") < text.index("rtt ms")
    file = io.StringIO()
    Console(file=file, width=80, force_terminal=True, color_system="standard").print(screen)
    assert "\x1b[1;31mSECURITY\x1b[0m" in file.getvalue()
    assert "\x1b[1;31mfault" not in file.getvalue()


def test_everyday_problems_do_not_push_out_security() -> None:
    """All security lines are shown, and of the others as many as fit; the rest is counted."""
    security = [finding(f"s{n}", Severity.SECURITY, n=n) for n in range(30)]
    findings = [*security, *(finding(f"f{n}", n=n) for n in range(25))]
    text = words(render_status(status_of({"drone1": peer("up")}, findings=findings)))
    assert text.count("SECURITY") == 30
    assert text.count("fault ") == 20
    assert "and 5 more: `uavlinkd status --json` has all of them" in text


@pytest.mark.parametrize("condition", PathCondition)
@pytest.mark.parametrize("reason", ["unanswered", "loss", "network", "new"])
def test_every_condition_of_a_path_is_shown(condition: PathCondition, reason: str) -> None:
    """In a style of its own."""
    paths = [{**PATH, "state": condition.value, "reason": reason}, PATH]
    expected = "best" if condition is PathCondition.USABLE else condition.value
    assert expected in printed(render_status(status_of({"drone1": peer("up", paths=paths)})))


def test_path_by_tls_that_is_not_needed_is_no_failure() -> None:
    paths = [PATH, {**PATH, "network": "TLS", "state": "down", "reason": "closed"}]
    text = words(render_status(status_of({"drone1": peer("up", paths=paths)})), 90)
    assert "TLS 203.0.113.255:65535 not connected" in text
    assert "down" not in text


def test_relay_shows_its_members_those_that_are_down_first() -> None:
    """Whole on 80 columns, an address once for all ports; without tables of peers and endpoints that it lacks."""
    member = {"is_up": True, "since_s": 3540.0, "addresses": ["203.0.113.255:65535"] * 2}
    member |= {"bound": 1, "waiting": 0, "datagrams": 1_234_567, "over_limit": 5}
    members = {"drone1": member, "ground-station": {**member, "is_up": False, "addresses": []}}
    refused = {"unproven": 1204, "wrong_path": 7, "displaced": 9, "tls": 1}
    https = {"address": "0.0.0.0:443", "connections": 1002, "strangers": 2, "refused": refused}
    relay = {"members": members, "dropped": {"relay_unknown_handle": 7}, "https": https}
    text = words(render_status(status_of({}, relay=relay)))
    assert "relay: 1 of 2 members up" in text
    text = words(render_status(status_of({}, relay=relay)), 100)
    assert text.index("station - down 59 min") < text.index("drone1 203.0.113.255:65535 up 59 min 1 0 1,234,567")
    assert "not forwarded: 7 of an unknown handle of a relay" in text
    assert "by TLS at 0.0.0.0:443: 1,000 members, 2 strangers; refused so far: 1,204 unproven, 9 displaced, 7" in text
    https["refused"] = {}
    assert "refused so far" not in words(render_status(status_of({}, relay=relay)))
    assert "endpoint" not in text


@pytest.mark.parametrize(("is_verified", "says"), [(True, "proves"), (False, "does not prove")])
def test_an_endpoint_that_signs_has_a_line(is_verified: bool, says: str) -> None:
    """An endpoint without a key has none."""
    plain: dict[str, Any] = {"clients": {}, "frames_received": 0, "frames_sent": 0, "signing": None}
    plain |= {"faults": {}, "failures": {}, "refused": {}}
    signing = plain | {"signing": {"is_verified": is_verified, "link_id": 7}, "failures": {"bad_signature": 3}}
    text = words(render_status(status_of({}, endpoints={"autopilot": signing, "gcs": plain})))
    assert f"autopilot signing: the autopilot {says} the key, link id 7" in text
    assert "3 frames with a wrong signature" in text
    assert "gcs signing" not in text
