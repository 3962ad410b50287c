"""The screen of `uavlinkd status`."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any

import pytest
from rich.console import Console, RenderableType

from uavlinkd.core.drops import DropReason
from uavlinkd.core.path_state import PathCondition
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
from uavlinkd.relay.forwarding import RelayReason


def path(**facts: object) -> dict[str, Any]:
    """The status of a path."""
    return {
        "number": 1,
        "network": None,
        "address": "203.0.113.255:65535",
        "relay": None,
        "relay_address": None,
        "is_configured": True,
        "state": "usable",
        "reason": "answered",
        "state_s": 60.0,
        "role": "best",
        "carries": ["critical", "stream", "bulk"],
        "answered_s": 0.1,
        "round_trip_s": 1.2345,
        "jitter_s": 0.5678,
        "loss_in": 0.12,
        "loss_out": 1.0,
        "lag_s": 0.4,
        "bytes_in_s": 123456.0,
        "bytes_out_s": 1234.0,
        "bytes_received": 123_456_789,
        "bytes_sent": 1_234_567,
        **facts,
    }


def peer(state: str, **facts: object) -> dict[str, Any]:
    """The status of a peer."""
    return {
        "state": state,
        "last_received_s": 12.3,
        "round_trip_s": 0.1234,
        "freshness_unverified_s": None,
        "repair": {"is_on": False, "on_s": 0.0, "transmissions": 1, "datagrams": 1234, "bytes": 123456},
        "loss_in": 0.12,
        "loss_out": 1.0,
        "bytes_in_s": 123456.0,
        "bytes_out_s": 123456.0,
        "path": "203.0.113.255:65535",
        "paths": [path()],
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
        "networks": {},
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
    dropped = "1,234,567 replayed, 12 altered or forged, 1 of an ended session"
    assert f"{name} dropped: {dropped}" in words(text)


def test_copies_along_several_paths_are_not_drops() -> None:
    """They are in the JSON only."""
    text = shown({"drone1": peer("up", drops={"duplicate": 12, "late_copy": 3})}, 80)
    assert "dropped" not in text


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
    lists: list[tuple[Iterable[StrEnum], Mapping[str, str]]] = [
        ((*DropReason, *RelayReason), DATAGRAMS),
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


def test_networks_are_shown_with_their_addresses() -> None:
    """An absent one with the reason."""
    shared = {"budget_bits_s": 0, "ports": [], "serial": None}
    networks: dict[str, dict[str, object]] = {
        "lte": {"interface": "wwan0", "address": None, "is_metered": True, "is_present": True, **shared},
        "mesh": {"interface": None, "address": "10.13.0.5", "is_metered": False, "is_present": False, **shared},
    }
    networks["lte"] |= {"absent_because": None, "addresses": ["10.0.0.5"]}
    networks["mesh"] |= {"absent_because": "no interface has 10.13.0.5", "addresses": []}
    text = printed(render_status(status_of({}, networks=networks)), 80)
    assert "wwan0" in text
    assert re.search(r"lte +wwan0 +yes +10\.0\.0\.5", text)
    assert re.search(r"mesh +10\.13\.0\.5 +no +absent: no interface has 10\.13\.0\.5", text)


def test_serial_network_is_shown_with_its_radio() -> None:
    """The device, the rate, damaged pieces, and what the modem reports, if it does."""
    line: dict[str, object] = {"device": "/dev/ttyUSB0", "baud": 57600, "rate_bits_s": 9600, "line_noise": 3}
    network = {"interface": None, "address": None, "is_metered": False, "is_present": True, "addresses": ["serial"]}
    quiet = {**network, "serial": {**line, "radio": None}}
    text = printed(render_status(status_of({}, networks={"sik": quiet})), 120)
    assert re.search(r"sik +/dev/ttyUSB0 at 57600 baud +no +up to 9,600 bits/s, 3 damaged", text)
    radio = {"rssi": 200, "remrssi": 190, "noise": 50, "remnoise": 60, "txbuf": 90}
    text = printed(render_status(status_of({}, networks={"sik": {**quiet, "serial": {**line, "radio": radio}}})), 160)
    assert "rssi 200/190, noise 50/60, modem 10 % full" in text


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


def test_repair_and_its_cost_are_shown() -> None:
    """While it is on."""
    repair = {"is_on": True, "on_s": 12.3, "transmissions": 5, "datagrams": 1234, "bytes": 123456}
    text = " ".join(shown({"drone1": {**peer("up"), "repair": repair}}, 100, endpoints={}).split())
    assert "drone1 repair: on for 12.3 s, sends critical frames 5 times; 123 kB repeated so far" in text


DOWN: dict[str, Any] = {
    "network": "mesh",
    "address": "10.13.0.9:5790",
    "state": "down",
    "reason": "unanswered",
    "role": "standby",
    "carries": [],
    "round_trip_s": None,
    "jitter_s": None,
    "lag_s": None,
}


def test_peer_with_several_paths_has_a_line_for_each() -> None:
    """Network, address, state with its reason or role, what it carries, round trip and jitter, losses, rates."""
    paths = [
        path(network="lte"),
        path(**DOWN),
        path(role="standby", carries=["critical"], state="suspect", reason="loss"),
    ]
    text = shown({"drone1": peer("up", paths=paths), "drone2": peer("up")}, 80)
    assert max(map(len, text.splitlines())) <= 80
    lines = [words(line) for line in text.splitlines()]
    assert "path state carries rtt ms loss % kB/s" in lines
    assert "mesh 10.13.0.9:5790 down: no answer - - 12/100 123/1.2" in lines
    assert "lte 203.0.113.255:65535 best all 1234±568 12/100 123/1.2" in lines
    assert "203.0.113.255:65535 suspect: loss critical 1234±568 12/100 123/1.2" in lines
    assert text.count("drone2") == 2


def test_paths_along_two_ports_of_a_relay_are_distinguished() -> None:
    """By the relay's address, on 80 columns too."""
    relayed = {"address": "relayed via vps", "relay": "vps"}
    paths = [
        path(**relayed, relay_address="203.0.113.7:5790"),
        path(**relayed, relay_address="203.0.113.7:5791", role="standby"),
    ]
    text = shown({"drone1": peer("up", paths=paths)}, 80)
    assert max(map(len, text.splitlines())) <= 80
    lines = [words(line) for line in text.splitlines()]
    assert sum(line.startswith("relayed via vps at") for line in lines) == 2
    assert all(any(port in line for line in lines) for port in ("5790", "5791"))


def test_wide_screen_has_lag_and_bytes_of_each_path() -> None:
    """Where there is room."""
    paths = [path(network="lte"), path(**DOWN)]
    lines = [words(line) for line in shown({"drone1": peer("up", paths=paths)}, 120).splitlines()]
    assert "path state carries rtt ms loss % kB/s lag ms MB" in lines
    assert "lte 203.0.113.255:65535 best all 1234±568 12/100 123/1.2 400 123/1.2" in lines
    assert "mesh 10.13.0.9:5790 down: no answer - - 12/100 123/1.2 - 123/1.2" in lines


def test_peer_with_one_path_has_no_table_of_paths() -> None:
    """Its path is in the table of sessions."""
    assert "carries" not in shown({"drone1": peer("up")}, 120)


def test_every_condition_of_a_path_has_a_style() -> None:
    """And each reason for which a path is not usable has words."""
    for condition in PathCondition:
        for reason in ("unanswered", "loss", "network", "new"):
            paths = [path(state=condition.value, reason=reason), path()]
            shown_as = "best" if condition is PathCondition.USABLE else condition.value
            assert shown_as in shown({"drone1": peer("up", paths=paths)}, 80)


def test_relay_shows_its_members_those_that_are_down_first() -> None:
    """Without tables of peers and endpoints that it does not have."""
    member = {
        "is_up": True,
        "since_s": 60.0,
        "addresses": ["203.0.113.7:4000"],
        "bound": 1,
        "waiting": 0,
        "datagrams": 1234,
        "over_limit": 5,
    }
    down = {**member, "is_up": False, "addresses": [], "over_limit": 0}
    relay = {"members": {"drone1": member, "drone2": down}, "dropped": {"relay_unknown_handle": 7}}
    text = printed(render_status(status_of({}, endpoints={}, relay=relay)), 120)
    assert "relay: 1 of 2 members up" in text
    assert text.index("drone2") < text.index("drone1 ")
    assert "203.0.113.7:4000" in text
    assert "not forwarded: 7 of an unknown handle of a relay" in text
    assert "endpoint" not in text


def test_members_of_a_relay_are_printed_whole_on_80_columns() -> None:
    """A name or address that was cut is of no use."""
    member = {"is_up": False, "since_s": 3540.0, "addresses": ["203.0.113.255:65535", "203.0.113.255:65535"]}
    counts = {"bound": 1, "waiting": 0, "datagrams": 1_234_567, "over_limit": 0}
    relay = {"members": {"ground-station": member | counts}, "dropped": {}}
    text = printed(render_status(status_of({}, endpoints={}, relay=relay)), 80)
    assert "…" not in text
    for whole in ("ground-station", "down 59 min", "203.0.113.255:65535", "1,234,567"):
        assert whole in text
    assert text.count("203.0.113.255") == 1, "once for all ports of the relay"
    assert all(len(line) <= 80 for line in text.splitlines())


def test_relays_of_a_member_have_a_line_each() -> None:
    """With the state of each peer there."""
    used = {"state": "up", "peer": None, "round_trip_s": 0.0123, "peers": {"drone1": "bound", "drone2": "waiting"}}
    lost: dict[str, Any] = {"state": "lost", "peer": "station", "round_trip_s": None, "peers": {}}
    status = status_of({}, endpoints={}, relays={"vps": used, "spare": lost}, send_failures={"relay_handle_gone": 1})
    text = printed(render_status(status), 120)
    assert "relay vps: up, 12 ms; drone1 bound, drone2 waiting" in text
    assert "relay spare, also the peer station: lost; no peer uses it" in text
    assert "not sent: 1, because a relay no longer forwards to the peer" in text
