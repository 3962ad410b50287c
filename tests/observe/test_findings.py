"""Each problem has its finding, and no other. Real daemons make the common ones in `tests/mistakes`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from math import inf
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.test_evidence import OWN_KEY, THERE, Scene
from tests.observe.daemon_parts import parts_of
from tests.processes.frames import command_long, heartbeat
from tests.protocol.harness import PLAIN
from tests.samples import blank
from tests.test_readmes import ROOT
from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import EndpointConfig, PeerConfig
from uavlinkd.daemon.evidence import EVIDENCE_S, REPORTED
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.io.url import StationUrl, parse_url
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.egress.peer_egress import EgressSettings, PeerEgress
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.routing import Router
from uavlinkd.observe.facts import ANSWERED_FRAMES, ICMP_S, SECURITY_S, is_contested, is_reached
from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.observe.findings import find, has_no_client, own_codes, stop_frames
from uavlinkd.observe.history import HIDDEN_LEAST, History
from uavlinkd.observe.signs import UNREACHED_S
from uavlinkd.observe.table import ROWS, Exit
from uavlinkd.observe.traffic_signs import PROBLEMS
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Dropped
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.reports import ProblemClaim
from uavlinkd.protocol.sessions import Twin
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.wire import RefusalReport, Refused
from uavlinkd.system.addresses import Address

NOW = 1.0
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
STRANGER = ("198.51.100.7", 5790)


class Daemon(Scene):
    """A daemon with the peer drone1, which is down, and no endpoint."""

    def __init__(self) -> None:
        super().__init__()
        self.now = NOW
        self.history = History(0.0)
        self.router = Router[Any]()
        self.parts = parts_of(self.node, self.links, self.evidence, self.router)
        self.parts.config.public_key = OWN_KEY
        self.sockets: Any = self.parts.peer_sockets
        self.local: list[Any] = self.parts.local.endpoints

    def findings(self, now: float | None = None) -> dict[str, Finding]:
        """The findings, by cause."""
        findings = find(self.parts, self.history, self.now if now is None else now)
        assert findings == sorted(findings, key=lambda one: one.severity)
        return {finding.cause: finding for finding in findings}

    def dropped(self, reason: DropReason, at: tuple[str, int], detail: bytes | str | int = "") -> None:
        """A datagram from there."""
        peer = self.link.peer if reason in (DropReason.BAD_HANDSHAKE, DropReason.SUITE_NOT_ACCEPTED) else None
        self.evidence.add_dropped(Dropped(reason, peer, Path(0, at), 1, detail), self.now)

    def set_up(self, **rules: object) -> PeerLink:
        """The link is up, with these rules for the peer."""
        self.link.config = PeerConfig(self.link.config.settings, self.link.config.addresses, rules)
        self.link.policy = self.link.config.make_policy()
        self.link.peer.is_up = True
        self.router.add_port(self.link, is_peer=True)
        return self.link

    def cross(self, received: Iterable[bytes] = (), sent: Iterable[bytes] = (), seconds: int = 1) -> None:
        """Frames from and to the peer in one second, which its policy judges; then others without any."""
        self.now += 1.0
        for frame in split_payload(b"".join(received), self.link.counters):
            self.link.policy.incoming.check(frame, self.now)
        for frame in split_payload(b"".join(sent), self.link.counters):
            self.link.counters.frames -= 1
            self.link.frames_sent += self.link.policy.outgoing.check(frame, self.now) is None
        self.sample()
        for _ in range(seconds - 1):
            self.now += 1.0
            self.sample()

    def sample(self) -> None:
        """What a daemon does each second."""
        self.history.sample(self.links.values(), [(one, one.policy) for one in self.local], self.now)


@pytest.fixture
def daemon() -> Daemon:
    return Daemon()


def test_the_documented_causes_are_those_of_the_table() -> None:
    """The README has a line for each cause, with severity and exit status. Only attacks are security."""
    section = (ROOT / "uavlinkd/ops/README.md").read_text().partition("### Causes")[2].partition("\n##")[0]
    documented = [line for line in section.splitlines() if line.startswith("| `") and "`cause`" not in line]
    worst = {row.cause: row for row in sorted(ROWS, key=lambda row: row.severity, reverse=True)}
    causes = dict.fromkeys(row.cause for row in ROWS)
    assert [line.split(" | ")[:2] + line.split(" | ")[3:] for line in documented] == [
        [f"| `{row.cause}`", row.severity.name.lower(), f"{row.exit.value} |"]
        for row in map(worst.__getitem__, causes)
    ]
    assert {row.cause for row in ROWS if row.severity is Severity.SECURITY} == {
        *("own_key_elsewhere", "key_on_two_machines", "hidden_frame", "bulletin_conflict")
    }


def test_a_finding_of_the_table_decides_the_exit_status() -> None:
    """By its cause and severity: a part of the frames of a foreign system stops nothing."""
    (row,) = [row for row in ROWS if row.cause == "all_refused" and row.exit is Exit.FAILED][:1]
    for cause, severity, stops in (
        (row.cause, Severity.FAULT, True),
        ("foreign_system", Severity.FAULT, True),
        ("foreign_system", Severity.WARNING, False),
        ("no_client", Severity.WARNING, False),
    ):
        assert stop_frames([Finding(cause, severity, Subject.PEER, "drone1", "", "")]) is stops


# A peer that is down.


def test_absent_own_address_explains_that_nothing_can_be_sent(daemon: Daemon) -> None:
    """It has a line of its own, so the peers have none about routes. It is a warning while all peers are up."""
    daemon.evidence.add_error("EINVAL", THERE, NOW)
    daemon.sockets.absent_addresses = lambda: [Address("192.0.2.77", 5799)]
    daemon.sockets.absent_networks = lambda: {"lte (wwan0: no interface)": "plug the modem in"}
    assert set(daemon.findings()) == {"listen_address_missing", "network_absent"}
    assert {finding.severity for finding in daemon.findings().values()} == {Severity.FAULT}
    assert '"0.0.0.0:5799"' in daemon.findings()["listen_address_missing"].remedy
    daemon.set_up(role="all", system_ids="all")
    assert {finding.severity for finding in daemon.findings().values()} == {Severity.WARNING}


def test_reports_of_the_network(daemon: Daemon) -> None:
    """An error of ICMP comes after what arrived, until two tries had no such message."""
    daemon.evidence.add_error("icmp_ECONNREFUSED", THERE, NOW)
    daemon.link.peer.initiator.begin_try(NOW)
    assert set(daemon.findings()) == {"no_listener"}
    daemon.dropped(DropReason.BAD_MAC1, THERE)
    assert list(daemon.findings()) == ["wrong_key_there", "no_listener"]
    assert encode_key(OWN_KEY) in daemon.findings()["wrong_key_there"].remedy
    assert list(daemon.findings(NOW + 2 * PLAIN.timers.retry_min_s * (1 + c.RETRY_JITTER) + ICMP_S + 0.1)) == [
        "wrong_key_there"
    ]


def test_addresses_that_cannot_be_used(daemon: Daemon) -> None:
    """Names that do not resolve, and another family than that of listen."""
    daemon.sockets.unresolved = lambda name: {"b.test", "a.test"}
    assert daemon.findings()["name_not_resolved"].text.startswith("a.test, b.test ")
    daemon.sockets.unresolved = lambda name: set[str]()
    assert daemon.findings() == {}
    daemon.sockets.without_socket = {"drone1"}
    assert daemon.findings()["no_route"].remedy == 'add "[::]:5799" to listen'
    daemon.sockets.networks.networks = [object()]
    assert "address families" in daemon.findings()["no_route"].remedy


def test_idle_link_without_a_path_is_not_up(daemon: Daemon) -> None:
    """It sends every 10 s only. While frames arrive, answers may be held back: that is another finding."""
    link = daemon.set_up(role="all", system_ids="all")
    link.peer.received_at = NOW
    state = link.peer.paths.learn(Path(0, THERE), NOW)
    for condition, silent_s, is_up in (
        (PathCondition.DOWN, c.LOST_AFTER_S - 0.1, True),
        (PathCondition.DOWN, c.LOST_AFTER_S, False),
        (PathCondition.SUSPECT, c.LOST_AFTER_S, True),
    ):
        state.condition = condition
        assert is_reached(daemon.parts, link.peer, NOW + silent_s) is is_up
        assert ("no_answer" in daemon.findings(NOW + silent_s)) is not is_up


def test_relay_that_no_datagram_reaches(daemon: Daemon) -> None:
    """A closed port of a VPS. Its members may be off: not at once."""
    daemon.parts.relay, daemon.parts.line = SimpleNamespace(members={}), SimpleNamespace(read_at=0.0)
    assert "no_datagram" not in daemon.findings(UNREACHED_S - 0.1)
    finding = daemon.findings(UNREACHED_S)["no_datagram"]
    assert finding.text == "no datagram has reached UDP port 5799 since the start, 15 s ago"
    assert stop_frames([finding])
    daemon.parts.line.read_at = 1.0
    assert "no_datagram" not in daemon.findings(UNREACHED_S)


def test_evidence_from_before_the_link_went_down_does_not_count(daemon: Daemon) -> None:
    """Also what an attacker sent while it was up. After a time, the silence is reported."""
    daemon.dropped(DropReason.BAD_MAC1, THERE)
    daemon.link.expected_since = NOW + 1.0
    assert daemon.findings(NOW + 2.0) == {}
    assert set(daemon.findings(NOW + 20.0)) == {"no_answer"}
    daemon.set_up(role="all", system_ids="all")
    daemon.link.expected_since = 0.0
    assert daemon.findings() == {}, "the link is up"


def test_a_peer_that_was_stopped_closed_the_link(daemon: Daemon) -> None:
    """One fault, without advice about firewalls, until something new comes from the peer."""
    daemon.link.on_down(NOW, is_closed=True)
    daemon.evidence.add_error(f"{REPORTED}ECONNREFUSED", THERE, NOW + 12.0)
    (finding,) = daemon.findings(NOW + 12.4).values()
    assert (finding.cause, finding.text.partition(":")[0]) == ("closed_by_peer", "closed by the peer, 12 s ago")
    daemon.link.peer.received_at = NOW + 1.0
    daemon.evidence.add_error(f"{REPORTED}ECONNREFUSED", THERE, NOW + 12.0)
    assert set(daemon.findings(NOW + 12.4)) == {"no_listener"}


def test_other_version_names_the_older_side(daemon: Daemon) -> None:
    """It explains the initiations above the limit of comparisons, which count as for another key."""
    daemon.dropped(DropReason.BAD_MAC1, THERE)
    older, newer = c.PROTOCOL_VERSION - 1, c.PROTOCOL_VERSION + 1
    for version, remedy in (
        (older, "update uavlinkd at drone1:"),
        (newer, " and at drone0, this machine"),
    ):
        daemon.dropped(DropReason.OTHER_VERSION, THERE, version)
        findings = daemon.findings()
        assert set(findings) == {"other_version"}
        assert f"uavlink/{version}, this daemon uavlink/{c.PROTOCOL_VERSION}" in findings["other_version"].text
        assert remedy in findings["other_version"].remedy


def test_keys_that_arrive_are_shown_and_never_advised(daemon: Daemon) -> None:
    """Of several from one address at least one is not the peer's."""
    keys = [bytes([number]) * 32 for number in (12, 13)]
    for key in keys:
        daemon.dropped(DropReason.UNKNOWN_PEER, THERE, key)
    findings = daemon.findings()
    assert set(findings) == {"wrong_key_here"}
    where = " at 192.0.2.2:5790, ".join(map(encode_key, keys))
    assert f"2 keys, so at least one is not drone1: {where} at " in findings["wrong_key_here"].text
    assert all(encode_key(key) not in findings["wrong_key_here"].remedy for key in keys)


def test_key_of_the_only_peer_without_addresses(daemon: Daemon) -> None:
    """A ground station that only waits shows the key, unless the sender may be one of several peers."""
    del daemon.links["drone1"]
    daemon.link = daemon.add("waited", bytes([3]) * 32, [])
    daemon.dropped(DropReason.UNKNOWN_PEER, STRANGER, bytes([11]) * 32)
    assert encode_key(bytes([11]) * 32) in daemon.findings()["wrong_key_here"].text
    assert set(daemon.findings(20.0)) == {"wrong_key_here"}
    daemon.add("other", bytes([4]) * 32, [])
    assert daemon.findings() == {}
    assert set(daemon.findings(20.0)) == {"not_connecting"}


def test_remedies_weaken_nothing_if_the_evidence_is_forged(daemon: Daemon) -> None:
    """One changed byte of a response, or an old initiation, must not cost a PSK or a strong suite."""
    daemon.dropped(DropReason.BAD_HANDSHAKE, THERE)
    daemon.dropped(DropReason.SUITE_NOT_ACCEPTED, THERE, "x25519")
    findings = daemon.findings()
    assert set(findings) == {"wrong_psk", "no_common_suite"}
    assert "never remove a PSK: the message may be forged" in findings["wrong_psk"].remedy
    assert "write this end's suites at drone1" in findings["no_common_suite"].remedy
    assert "an old recording can cause this" in findings["no_common_suite"].remedy


# The daemon.


def test_own_key_on_another_machine(daemon: Daemon) -> None:
    """It is the first line, and other keys do not hide it."""
    daemon.dropped(DropReason.UNKNOWN_PEER, STRANGER, OWN_KEY)
    daemon.dropped(DropReason.UNKNOWN_PEER, THERE, bytes([11]) * 32)
    first = next(iter(daemon.findings().values()))
    assert (first.cause, first.severity) == ("own_key_elsewhere", Severity.SECURITY)
    assert "198.51.100.7:5790 uses this daemon's private key, or an attacker replays an old recording" in first.text
    assert "own_key_elsewhere" not in daemon.findings(NOW + SECURITY_S + 1)


def test_senders_without_a_member_here_have_their_own_addresses(daemon: Daemon) -> None:
    """At a relay, two keys from two places."""
    daemon.parts.relay = SimpleNamespace(members={})
    keys = {bytes([number]) * 32: (f"198.51.100.{number}", 5790) for number in (11, 12)}
    for key, address in keys.items():
        daemon.dropped(DropReason.UNKNOWN_PEER, address, key)
    shown = ", ".join(f"{encode_key(key)} at {host}:{port}" for key, (host, port) in keys.items())
    assert daemon.findings()["not_a_member"].text.endswith(shown)


# A peer that is up.


def test_system_of_another(daemon: Daemon) -> None:
    """A client that forwards frames, an id that is used twice, or an attack: trusting it is never advised."""
    daemon.set_up(role="all", system_ids=[1])
    for _ in range(3):
        daemon.cross([heartbeat(1), heartbeat(7)])
    findings = daemon.findings()
    assert set(findings) == {"foreign_system"}
    assert "of system 7; its system_ids here are 1" in findings["foreign_system"].text
    assert "only if you know that drone1 has this id" in findings["foreign_system"].remedy
    settings = daemon.link.config.settings
    daemon.link.config = replace(daemon.link.config, settings=replace(settings, is_certified=True))
    assert "`uavlinkd fleet sign --replace drone1 --id 7`" in daemon.findings()["foreign_system"].remedy


def made_up_endpoint(config: EndpointConfig) -> Any:
    """An endpoint without a client, which signs nothing."""
    empty: Any = {"ports": [], "frames_sent": 0, "signing": None, "is_station": False}
    return SimpleNamespace(
        name=config.name, failures=Counter(), counters=SplitCounters(), policy=config.make_policy(), **empty
    )


def test_autopilot_with_another_system_id(daemon: Daemon) -> None:
    """The remedy names the parameters of both autopilots, and never a role."""
    daemon.set_up(role="all", system_ids=[1])
    rules: Any = {"system_ids": [3]}
    config = EndpointConfig("autopilot", parse_url("udpin:127.0.0.1:14550"), policy=rules)
    local = made_up_endpoint(config)
    daemon.parts.config.endpoints.append(config)
    daemon.local.append(local)
    for frame in split_payload(heartbeat(1), local.counters):
        local.policy.incoming.check(frame, daemon.now)
    daemon.sample()
    findings = daemon.findings()
    assert set(findings) == {"foreign_system"}
    assert (
        "set MAV_SYSID (ArduPilot; before 4.7 SYSID_THISMAV) or MAV_SYS_ID (PX4)" in findings["foreign_system"].remedy
    )
    assert "only if you know that autopilot has this id, and no other has it" in findings["foreign_system"].remedy
    found = find(daemon.parts, daemon.history, daemon.now)
    assert own_codes(found, is_cut_off=False) == [1], "its peers see that it refuses its own autopilot"
    assert not own_codes([one._replace(subject=Subject.PEER) for one in found], is_cut_off=False)


@pytest.mark.parametrize(("received", "sent", "which"), [([heartbeat(1)], [], "from"), ([], [heartbeat(1)], "to")])
def test_policy_that_refuses_everything(daemon: Daemon, received: list[bytes], sent: list[bytes], which: str) -> None:
    """In either direction."""
    daemon.set_up(allow_in=["PING"], allow_out=["PING"], system_ids=[1])
    daemon.cross(received, sent)
    text = daemon.findings()["all_refused"].text
    assert text.startswith(f"its policy refuses every frame {which} it: the role, or the lists")


@pytest.mark.parametrize(
    ("message", "hiding", "frames", "is_found"),
    [
        ("SERVO_OUTPUT_RAW", 1, 1, False),
        ("ATTITUDE", HIDDEN_LEAST, HIDDEN_LEAST, False),
        ("ATTITUDE", HIDDEN_LEAST + 1, HIDDEN_LEAST + 1, True),
        ("ATTITUDE", 60, 20_000, False),  # 0.3 % of random bytes, beside unknown messages that pass
        ("ATTITUDE", 60, 1500, True),
        ("LOG_DATA", 500, 500, False),  # a file with recorded MAVLink
        ("TUNNEL", 500, 500, False),
    ],
)
def test_hidden_frames_are_an_alarm_above_the_rate_of_honest_ones(
    daemon: Daemon, message: str, hiding: int, frames: int, is_found: bool
) -> None:
    """Of a captured member they are the first line, which everyday findings do not displace."""
    daemon.set_up(role="vehicle", system_ids=[1])
    daemon.cross([heartbeat(1), heartbeat(9)])
    gate = daemon.link.policy.incoming
    for number in range(1, 31):
        while gate.totals[Refusal.HIDDEN_FRAME] < hiding * number // 30:
            gate.count(blank(message).header, Refusal.HIDDEN_FRAME)
        daemon.link.counters.frames = 2 + frames * number // 30
        daemon.cross()
    first = next(iter(daemon.findings().values()), None)
    assert (first is not None and first.cause == "hidden_frame") is is_found
    if first is not None and is_found:
        assert first.severity is Severity.SECURITY
        assert first.text.startswith(f"{hiding:,} of its frames hid")


def test_commands_by_name(daemon: Daemon) -> None:
    """Those of a flight first, although sixty-four numbers without a name and ten other commands came before."""
    daemon.set_up(role="swarm-member", system_ids=[1])
    numbers = (*range(50000, 50064), *range(200, 210), ARM, mavlink.MAV_CMD_NAV_TAKEOFF)
    daemon.cross([], [command_long(number, 255) for number in numbers])
    withheld = daemon.findings()["commands_withheld"]
    assert withheld.text.startswith("COMMAND_LONG (COMPONENT_ARM_DISARM) 1x, COMMAND_LONG (NAV_TAKEOFF) 1x, ")
    assert withheld.text.endswith(" more withheld: role swarm-member")
    assert withheld.severity is Severity.WARNING


# What the peer claims to refuse.


def test_a_lying_peer_fills_one_line(daemon: Daemon) -> None:
    """Claims of unknown messages, commands and reasons are numbers, and their text is bounded."""
    claims = daemon.set_up(role="all", system_ids="all").peer.claims
    for number in range(100):
        entries = (Refused(0xFFFFFF - number, 60000 + place, 200, 2**32 - 1) for place in range(16))
        claims.note(RefusalReport(tuple(entries)), NOW)
    text = daemon.findings()["refused_there"].text
    assert "16777116 60015 (a reason that this version does not know, 4,294,967,295 frames, 0 s ago); " in text
    assert text.endswith("; and 61 more kinds of frames")
    assert len(text) < 500


# A private key on two machines.


def test_key_on_two_machines_is_named_for_ten_minutes(daemon: Daemon) -> None:
    """That of a peer, with its addresses, this daemon's own one, and at a relay those of its members."""
    peer = daemon.set_up(role="all", system_ids="all").peer
    for port in (1, 2):
        peer.paths.prefer(Path(0, ("192.0.2.1", port)), NOW)
    peer.sessions.twins[Twin.PEERS] = NOW
    finding = daemon.findings()["key_on_two_machines"]
    assert finding.text.startswith(
        "two machines use drone1's private key: sessions came from 192.0.2.1:1, 192.0.2.1:2;"
    )
    assert "an attacker that holds handshakes back" in finding.remedy
    assert "key_on_two_machines" not in daemon.findings(NOW + SECURITY_S)
    peer.sessions.twins = {Twin.OURS: NOW}
    text = daemon.findings()["key_on_two_machines"].text
    assert text.startswith("two machines use this daemon's private key: drone1 states a session with another one;")
    assert is_contested(peer, NOW + EVIDENCE_S - 1)
    assert not is_contested(peer, NOW + EVIDENCE_S), "frames pass again: the second machine is off"
    daemon.node.add_peer(PeerSettings("member", bytes([3]) * 32), 0.0).sessions.twins = {Twin.OURS: NOW}
    text = daemon.findings()["key_on_two_machines"].text
    assert "drone1, member states a session" in text, "a relay's own key too"
    daemon.node.peers["member"].sessions.twins = {}
    peer.sessions.twins = {Twin.PEERS: NOW}
    member = SimpleNamespace(peer=peer, peers=[peer], is_own=True, settings=SimpleNamespace(name="member"))
    daemon.parts.relay = SimpleNamespace(members={1: member, 2: SimpleNamespace(peer=peer, is_own=False)})
    here, of_peer = [one for one in find(daemon.parts, daemon.history, NOW) if one.cause == "key_on_two_machines"]
    assert "the private key of a member: member, from 192.0.2.1:1, 192.0.2.1:2;" in here.text
    assert of_peer.name == "drone1"


# Local endpoints.


@pytest.mark.parametrize(
    ("url", "cause"),
    [
        ("udpin:127.0.0.1:14550", "no_client"),
        ("serial:/dev/absent:57600", "device_unavailable"),
        ("tcp:127.0.0.1:5760", "client_unreachable"),
    ],
)
def test_frames_cannot_pass_without_any_client(daemon: Daemon, url: str, cause: str) -> None:
    """From 5 s on, unless one endpoint has a client, also one that only listens. A hub has no endpoint."""
    for name in ("autopilot", "companion"):
        daemon.local.append(SimpleNamespace(name=name, ports=[], signing=None, is_station=False))
        daemon.parts.config.endpoints.append(SimpleNamespace(name=name, url=parse_url(url), policy={}))
    assert not has_no_client(find(daemon.parts, daemon.history, 4.9), daemon.local)
    found = find(daemon.parts, daemon.history, 5.0)
    assert [one.cause for one in found if one.subject is Subject.ENDPOINT] == [cause, cause]
    assert has_no_client(found, daemon.local)
    off, on = (cast(Any, SimpleNamespace(is_station=True, ports=ports)) for ports in ([], ["10.66.0.2"]))
    assert has_no_client(found, [*daemon.local, off])
    assert not has_no_client(found, [*daemon.local, on])
    daemon.local[0].ports = [SimpleNamespace(name="127.0.0.1:40000")]
    found = find(daemon.parts, daemon.history, 5.0)
    assert "client_silent" in {one.cause for one in found}
    assert not has_no_client(found, daemon.local)
    assert not has_no_client([], [])


def test_ground_control_software_speaks_after_a_vehicle(daemon: Daemon) -> None:
    """Its silence is normal until a frame went out to it. A station that is off is no problem at all."""
    station = StationUrl("10.66.0.2", (14550,), bytes(32))
    for name, url in (("ground", parse_url("udpout:127.0.0.1:14550")), ("tablet", station)):
        daemon.parts.config.endpoints.append(EndpointConfig(name, url, policy={"role": "all", "system_ids": "all"}))
        daemon.local.append(made_up_endpoint(daemon.parts.config.endpoints[-1]))
    ground = daemon.local[0]
    ground.ports = [SimpleNamespace(name="127.0.0.1:14550")]
    daemon.set_up(role="vehicle", system_ids="all")
    assert daemon.findings(52.0) == {}
    ground.frames_sent = ANSWERED_FRAMES
    assert daemon.findings(52.0)["client_silent"][4:] == (
        "no ground control software or other client answers on 127.0.0.1:14550",
        "open it; it must not only listen",
    )


# What a peer says about itself.


def test_a_peer_says_what_its_problems_are(daemon: Daemon) -> None:
    """As its word, while it is up and repeats it. Only what stops frames is a fault; unknown codes are numbers."""
    peer = daemon.set_up(role="all", system_ids="all").peer
    for codes, severity in (((2, 3), Severity.FAULT), ((3, 200), Severity.WARNING)):
        peer.claims.problems = ProblemClaim(codes, NOW)
        assert daemon.findings()["problems_there"].severity is severity
    text = daemon.findings()["problems_there"].text
    assert text == "it says about itself: an endpoint has no client; problem 200"
    assert daemon.findings()["problems_there"].remedy.startswith("look at the power")
    peer.claims.problems = ProblemClaim((200,), NOW)
    assert daemon.findings()["problems_there"].remedy == "run `uavlinkd status` there"
    assert "problems_there" not in daemon.findings(NOW + c.PROBLEMS_LAST_S + 1)
    peer.is_up = False
    assert "problems_there" not in daemon.findings()


@pytest.mark.parametrize(
    ("role", "codes", "telemetry", "severity", "remedy"),
    [
        ("vehicle", (1,), [], Severity.FAULT, "set MAV_SYSID (ArduPilot"),
        ("vehicle", (2,), [], Severity.FAULT, "look at the power"),
        ("vehicle", (2,), [heartbeat(7)], Severity.WARNING, "look at the power"),
        ("operator", (1,), [], Severity.FAULT, "set the system id of its ground control software to 7"),
        ("operator", (2,), [], Severity.WARNING, "open its ground control software"),
    ],
)
def test_what_a_peer_says_is_mended_without_a_login_there(
    daemon: Daemon, role: str, codes: tuple[int, ...], telemetry: list[bytes], severity: Severity, remedy: str
) -> None:
    """Telemetry contradicts it at once. An operator whose software is closed stops no other one."""
    link = daemon.set_up(role=role, system_ids=["7"])
    for frame in split_payload(b"".join(telemetry), link.counters):
        link.vehicles.note(frame, NOW)
    link.peer.claims.problems = ProblemClaim(codes, NOW)
    finding = daemon.findings()["problems_there"]
    assert finding.severity is severity
    assert finding.remedy.startswith(remedy)


def test_a_daemon_reports_its_own_problems_only(daemon: Daemon) -> None:
    """Not what it finds about peers, nor what they say. Each code is in the specification, with its name."""
    daemon.local.append(SimpleNamespace(name="autopilot", ports=[], signing=None, is_station=False))
    url = parse_url("udpin:127.0.0.1:14550")
    daemon.parts.config.endpoints.append(SimpleNamespace(name="autopilot", url=url, policy={}))
    daemon.set_up(role="all", system_ids="all").peer.claims.problems = ProblemClaim((1,), 6.0)
    found = find(daemon.parts, daemon.history, 6.0)
    assert own_codes(found, is_cut_off=has_no_client(found, daemon.local)) == [2]
    text = (
        (ROOT / "uavlinkd/protocol/README.md").read_text().partition("### Problem reports")[2].partition("\n## ")[0]
    )
    assert {int(code): name for code, name in re.findall(r"\| (\d+) \| `(\w+)`", text)} == {
        code: name for code, (name, _) in PROBLEMS.items()
    }


def test_frames_that_were_dropped_here_are_named() -> None:
    """They waited for a budget or a connection by TLS. Newer states that replace older ones are no problem."""
    daemon = Daemon()
    egress = PeerEgress(EgressSettings(), NOW)
    daemon.set_up(role="all", system_ids="all").pacer.egress = egress
    egress.totals[EgressDrop.THINNED] = 1000
    daemon.cross(sent=[heartbeat()])
    assert daemon.findings() == {}
    egress.totals[EgressDrop.OVERFLOW] = 1748
    daemon.cross(sent=[heartbeat()])
    assert "1,748 frames to it waited here" in daemon.findings()["frames_unsent"].text
    assert "frames_unsent" not in daemon.findings(daemon.now + 11)


@pytest.mark.parametrize("url", ["udpin:0.0.0.0:14550", "udpout:192.0.2.1:14550"])
def test_send_error_that_lasts_is_named_while_the_client_sends(daemon: Daemon, url: str) -> None:
    """Whichever error it is: nothing else shows that one direction is blocked."""
    endpoint: Any = SimpleNamespace(name="ground", ports=[SimpleNamespace(name="192.0.2.1:1")], frames_sent=0)
    endpoint.signing = None
    endpoint.counters, endpoint.failures = SplitCounters(), Counter[str]()
    daemon.local.append(endpoint)
    daemon.parts.config.endpoints.append(SimpleNamespace(name="ground", url=parse_url(url), policy={}))
    for now in range(8):
        endpoint.counters.frames += 1
        endpoint.failures["EMSGSIZE"] += 1
        daemon.history.sample([], [(endpoint, Policy({}, is_local=True))], float(now))
        assert ("send_fails" in daemon.findings(float(now))) == (now >= 5)


@pytest.mark.parametrize(
    ("drop", "is_heard", "is_proven", "says"),
    [
        ("unsigned", False, True, "does not sign"),
        ("bad_signature", False, False, "signs with another key"),
        ("not_proven", True, False, "answers no question"),
        ("replayed", False, True, "answers no question"),  # it forgot its timestamp, and does not hear that
        ("unsigned", True, True, ""),  # those of another client
    ],
)
def test_autopilot_that_does_not_prove_its_key(
    daemon: Daemon, drop: str, is_heard: bool, is_proven: bool, says: str
) -> None:
    """Once it lasts. What others send to an endpoint whose autopilot signs is only counted."""
    daemon.parts.config.endpoints.append(config := EndpointConfig("autopilot", parse_url("udpin:127.0.0.1:14550")))
    daemon.local.append(endpoint := made_up_endpoint(config))
    endpoint.signing = SimpleNamespace(is_proven=is_proven, verified_at=-inf)
    for _ in range(7):
        daemon.now += 1.0
        endpoint.counters.frames += 1
        endpoint.failures[drop] += 1
        endpoint.signing.verified_at = daemon.now if is_heard else -inf
        daemon.sample()
    finding = daemon.findings().get("autopilot_unverified")
    assert (finding is not None) == bool(says)
    assert finding is None or (says in finding.text and stop_frames([finding]))


def test_senders_that_are_too_many(daemon: Daemon) -> None:
    """Frames without a signature, for 10 s."""
    config = EndpointConfig("autopilot", parse_url("udpin:127.0.0.1:14550"))
    daemon.parts.config.endpoints.append(config)
    daemon.local.append(endpoint := made_up_endpoint(config))
    endpoint.signing = SimpleNamespace(is_proven=True, verified_at=-inf)
    endpoint.failures["too_many_senders"] += 3
    daemon.sample()
    finding = daemon.findings()["too_many_senders"]
    assert finding.text.startswith("3 frames to autopilot got no signature")
    assert "too_many_senders" not in daemon.findings(daemon.now + 11)
