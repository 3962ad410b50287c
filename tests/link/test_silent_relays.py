"""UDP that is blocked is not a relay that is off: other answers and ICMP messages show the difference."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tests.core.harness import PLAIN
from tests.link.test_diagnosis import NOW, Daemon
from tests.link.test_evidence import THERE
from uavlinkd.config.model import PeerAddress, RelayConfig
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Dropped, PeerClosed
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link import diagnosis
from uavlinkd.link.down_problems import silent_relays
from uavlinkd.link.facts import Moment
from uavlinkd.link.peer_link import LOSSES, NOT_ANSWERING_S, PeerLink
from uavlinkd.link.relay_link import RelayHandles, RelayLink
from uavlinkd.link.traffic_problems import LOSS_LASTS_S
from uavlinkd.ops.findings import Finding, Severity
from uavlinkd.system.addresses import Address

FIRST, SECOND = ("203.0.113.1", 5790), ("203.0.113.2", 5790)
LATER = NOT_ANSWERING_S


class Member(Daemon):
    """A daemon with the peer drone1, which it reaches along relays."""

    def __init__(self) -> None:
        super().__init__()
        self.link.set_paths([], 0.0)
        self.relays: dict[str, RelayLink] = self.parts.relays.by_name
        self.evidence.relays = self.relays
        self.sockets.unresolved = lambda name: set[str]()

    def add_relay(self, name: str, *places: tuple[str, int]) -> RelayLink:
        """A relay at these places."""
        settings = PeerSettings(f"relay {name}", bytes([len(self.relays) + 9]) * 32, None, PLAIN)
        config = RelayConfig(settings, tuple(PeerAddress(Address(*place)) for place in places))
        relay = self.relays[name] = RelayLink(config, self.node, RelayHandles(), lambda *_: None, 0.0)
        relay.set_paths([Path(0, place) for place in places], 0.0)
        self.link.config = replace(self.link.config, addresses=(), relays=tuple(self.relays))
        return relay

    def answers(self, partner: RelayLink | PeerLink, at: tuple[str, int]) -> None:
        """A partner is up, along this path."""
        partner.peer.is_up, partner.peer.received_at = True, self.now
        state = partner.peer.paths.find(Path(0, at)) or partner.peer.paths.learn(Path(0, at), self.now)
        state.condition, state.answered_at = PathCondition.USABLE, self.now

    def only(self, now: float = LATER) -> Finding:
        """The only finding."""
        (finding,) = self.findings(now).values()
        return finding


@pytest.fixture
def member() -> Member:
    return Member()


def test_one_relay_alone_shows_only_possibilities(member: Member) -> None:
    """From three seconds on. A firewall here is one of them."""
    member.add_relay("one", FIRST)
    assert member.findings(LATER - 0.1) == {}
    finding = member.only()
    assert (finding.cause, finding.severity) == ("relay_not_answering", Severity.FAULT)
    assert "it is off, the address is wrong, a firewall drops UDP here or there, or keys" in finding.text
    assert "`nc -zvw3 203.0.113.1 22`" in finding.remedy


URL = "wss://one:443/uavlink"


def test_relay_that_does_not_answer_by_tls_either(member: Member) -> None:
    member.add_relay("one", FIRST)
    member.parts.peer_sockets.web.states = lambda addresses: {URL: "ECONNREFUSED"}
    finding = member.only()
    assert f": by TLS ({URL}) no process listens there now (ECONNREFUSED); by UDP it is off" in finding.text
    assert finding.remedy.startswith("start it, or correct the port; or run `uavlinkd status` at one")
    member.add_relay("two", SECOND)
    finding = member.only()
    assert finding.cause == "udp_blocked"
    assert f"(one, two); one by TLS ({URL}) no process listens" in finding.text
    assert finding.remedy.startswith("start it, or correct the port; or try another network")


@pytest.mark.parametrize(
    ("state", "text", "remedy"),
    [
        ("http_404", "a web server answers there, but not for this path (http_404)", "correct the URL, or"),
        ("proxy_407", "the proxy wants a name and password (proxy_407)", "write HTTPS_PROXY="),
        ("TimeoutError", "no answer in time (TimeoutError)", "open TCP port 443 at the relay"),
        ("connected", "it is connected, and gets no answer (silent)", "compare the public_key of the"),
        ("not connected", "not connected", "run `uavlinkd status` at one"),
    ],
)
def test_relay_with_a_url_alone(member: Member, state: str, text: str, remedy: str) -> None:
    """The finding names why it is not reached by TLS, and says nothing about UDP."""
    relay = member.add_relay("one")
    relay.set_paths([Path(7, (URL, 0))], 0.0)
    member.parts.peer_sockets.web.states = lambda addresses: {URL: state}
    assert member.findings(LATER - 0.1) == {}
    finding = member.only()
    assert (finding.cause, finding.severity) == ("relay_not_answering", Severity.FAULT)
    assert finding.text.endswith(f": by TLS ({URL}) {text}")
    assert finding.remedy.startswith(remedy)
    other = member.add_relay("two", FIRST)
    texts = [one.text for one in member.findings(LATER).values()]
    assert len(texts) == 1, "relays on two hosts, of which one has no address for UDP, show nothing about UDP"
    assert other in Moment(member.parts, LATER).silent_relays


@pytest.mark.parametrize("is_far", [True, False])
def test_relays_on_two_hosts_show_that_udp_is_probably_blocked(member: Member, is_far: bool) -> None:
    """Once for the peer. Two relays on one host say no more than one."""
    member.add_relay("one", FIRST)
    member.add_relay("two", SECOND if is_far else (FIRST[0], 5791))
    findings = member.findings(LATER)
    assert set(findings) == {"udp_blocked" if is_far else "relay_not_answering"}
    if is_far:
        text = findings["udp_blocked"].text
        assert text == "UDP is probably blocked here: none of 2 relays on different hosts answers (one, two)"
        assert "it must be a [[member]] there: `uavlinkd status`" in findings["udp_blocked"].remedy
        member.parts.fleet = object()
        (found,) = silent_relays(Moment(member.parts, LATER), list(member.relays.values()))
        assert "there, or a member of its fleet" in found.remedy


def test_two_addresses_of_one_relay_may_be_one_machine(member: Member) -> None:
    """Such as IPv4 and IPv6."""
    member.add_relay("one", FIRST, ("2001:db8::1", 5790))
    assert member.only().cause == "relay_not_answering"


def test_icmp_messages_are_answers(member: Member) -> None:
    """UDP gets out, and a message comes back, for some seconds after it."""
    member.add_relay("one", FIRST)
    member.add_relay("two", SECOND)
    for error, place in (("ECONNREFUSED", FIRST), ("EHOSTUNREACH", SECOND)):
        member.evidence.add_error(f"icmp_{error}", place, LATER)
    texts = [one.text for one in diagnosis.find(member.parts, LATER)]
    assert "no process listens there, or a firewall there rejects (ICMP)" in texts[0]
    assert "reports that 203.0.113.2:5790 is not reachable (EHOSTUNREACH, ICMP)" in texts[1]
    assert member.only(LATER + 6.0).cause == "udp_blocked"


def test_an_answer_elsewhere_shows_that_it_is_this_relay(member: Member) -> None:
    """Of a relay that no peer needs it is a warning. A private or local answer shows nothing about the internet."""
    silent, other = member.add_relay("one", FIRST), member.add_relay("two", SECOND)
    member.answers(other, SECOND)
    member.link.peer.is_up = True
    finding = member.only()
    assert (finding.cause, finding.severity, finding.name) == ("relay_not_answering", Severity.WARNING, "")
    assert (
        "the relay one does not answer at 203.0.113.1:5790: UDP gets out here (two at 203.0.113.2:5790"
        in finding.text
    )
    other.peer.is_up = False
    for near in (("192.168.1.7", 5790), ("127.0.0.1", 5790)):
        member.answers(member.link, near)
        other.peer.received_at = None
        assert member.only().cause == "udp_blocked"
    silent.set_paths([Path(0, ("192.168.1.9", 5790))], 0.0)
    other.set_paths([Path(0, ("192.168.1.10", 5790))], 0.0)
    assert all("UDP gets out here (drone1 at 192.168.1.7" in one.text for one in diagnosis.find(member.parts, LATER))


def test_an_answer_of_the_same_host_shows_that_it_is_the_port(member: Member) -> None:
    """Another port of the relay, or another relay or peer there."""
    relay = member.add_relay("one", FIRST, (FIRST[0], 5791))
    member.answers(relay, (FIRST[0], 5791))
    member.link.peer.is_up = True
    assert member.findings(LATER) == {}, "too few tries"
    state = relay.peer.paths.find(Path(0, FIRST))
    assert state is not None
    state.datagrams_sent = 3
    finding = member.only()
    assert (finding.cause, finding.severity) == ("relay_port_silent", Severity.WARNING)
    assert "no answer from 203.0.113.1:5790" in finding.text
    assert "that host answers (one at 203.0.113.1:5791)" in finding.text
    relay.peer.is_up = False
    relay.peer.received_at = None
    member.answers(member.link, (FIRST[0], 7000))
    assert "that host answers (drone1 at 203.0.113.1:7000), so the relay is off, its port wrong" in member.only().text


def test_a_relay_that_forwards_and_does_not_answer(member: Member) -> None:
    """The direction to it is blocked. One that answered before has its keys right."""
    relay = member.add_relay("one", FIRST)
    relay.peer.received_at = 0.0
    assert "it did before, so it is off, or UDP to it or back is blocked" in member.only().text
    member.link.set_relayed([relayed(0, "one", 7)], 0.0)
    member.link.peer.is_up = True
    member.link.peer.paths.states[0].received_at = LATER - 1.0
    assert "datagrams still come through it, so the direction from here to it is blocked" in member.only().text


def test_a_peer_that_is_not_bound_may_not_reach_the_relay(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor may it be on."""
    relay = member.add_relay("one", FIRST)
    monkeypatch.setattr(relay, "state_for", lambda _: "waiting")
    assert member.only().text.startswith(
        "drone1 is not bound at the relay one: it is off, cannot reach the relay (UDP"
    )


def test_known_reasons_do_not_look_like_a_firewall(member: Member) -> None:
    """A refused handshake, and an error of this machine."""
    relay = member.add_relay("one", FIRST)
    other = member.add_relay("two", SECOND)
    refused = Dropped(DropReason.BAD_HANDSHAKE, relay.peer, Path(0, FIRST), 1, "")
    member.evidence.add_dropped(refused, 1.0)
    member.evidence.add_error("EPERM", SECOND, 1.0)
    assert set(member.findings(LATER)) == {"wrong_psk", "firewall_here"}
    assert other.peer.received_at is None


def test_a_peer_that_was_up_and_is_silent(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as it is lost: nothing arrives, and what may differ was right before."""
    member.link.peer.received_at = LATER
    assert member.findings(2 * LATER - 0.1) == {}
    text = member.only(2 * LATER).text
    assert text == "nothing arrives from it any more: it is off, or the direction from it to here is blocked"
    relay = member.add_relay("one", FIRST)
    monkeypatch.setattr(relay, "state_for", lambda _: "bound")
    member.answers(relay, FIRST)
    assert "any more through the relay one, which answers: it is off" in member.only(2 * LATER).text


def test_a_partner_that_closes_may_start_again(member: Member) -> None:
    """Its silence begins then, however long nothing was sent before. One that is lost has been silent already."""
    relay = member.add_relay("one", FIRST)
    relay.on_event(PeerClosed(relay.peer), 9.0)
    member.link.on_down(9.0, is_closed=True)
    assert member.findings(9.0 + LATER - 0.1) == {}
    assert member.only(9.0 + LATER).cause == "relay_not_answering"
    member.link.on_down(13.0, is_closed=False)
    assert member.only(13.0).cause == "relay_not_answering"


def test_a_relay_that_closes_shows_nothing_about_keys(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer may be down already. While its relay answers, its keys may be wrong."""
    relay = member.add_relay("one", FIRST)
    monkeypatch.setattr(relay, "state_for", lambda _: "bound")
    member.answers(relay, FIRST)
    assert "keys or PSKs differ" in member.only(9.0).text
    relay.peer.is_up = False
    relay.on_event(PeerClosed(relay.peer), 9.0)
    finding = member.only(9.0)
    assert finding.text == "no answer through a relay (one): no session with a relay now, which may be starting again"
    assert member.only(9.0 + LATER).cause == "relay_not_answering"


def test_a_silent_peer_with_addresses_is_compared_with_others() -> None:
    """The text says whether UDP gets out here."""
    daemon = Daemon()
    assert "a firewall drops UDP here or there" in daemon.findings(LATER)["no_answer"].text
    other = daemon.add("drone2", bytes([3]) * 32, [FIRST])
    Member.answers(daemon, other, FIRST)  # type: ignore[arg-type]
    text = daemon.findings(LATER)["no_answer"].text
    assert "a firewall drops UDP there, while UDP gets out here (drone2 at 203.0.113.1:5790 answers)" in text


# One direction.


def waiting(*begun: float) -> dict[int, Any]:
    """Sessions that were not confirmed, begun at these times."""
    path = Path(0, THERE)
    return {
        number: SimpleNamespace(session=SimpleNamespace(created_at=at), paths=[path])
        for number, at in enumerate(begun)
    }


@pytest.mark.parametrize(
    ("is_up", "begun", "is_found"),
    [
        (False, (5.0,), True),
        (False, (5.1,), False),
        (False, (0.9,), False),
        (True, (3.0, 4.9), False),
        (True, (3.0, 5.0), True),
        (True, (1.0, 6.0), False),
    ],
)
def test_responses_that_do_not_arrive(is_up: bool, begun: tuple[float, ...], is_found: bool) -> None:
    """The relay names the member that initiates and is deaf; so does the end of a direct link."""
    daemon = Daemon()
    daemon.now, peer = 7.0, daemon.link.peer
    peer.is_up, peer.received_at = is_up, 1.0
    peer.sessions.current = SimpleNamespace(created_at=2.0) if is_up else None  # type: ignore[assignment]
    peer.sessions.unconfirmed = waiting(*begun)
    member = SimpleNamespace(peer=peer, peers=[peer], is_own=True, settings=SimpleNamespace(name="member"))
    daemon.parts.relay = SimpleNamespace(members={1: member})
    daemon.parts.links = {} if is_up else daemon.parts.links
    findings = daemon.findings()
    assert ("member_not_confirmed" in findings) is is_found
    assert ("not_confirmed" in findings) is (is_found and not is_up)
    if is_found:
        assert all("an attacker replays old initiations" in one.text for one in findings.values())
        text = findings["member_not_confirmed"].text
        assert text.startswith(
            "initiations of member at 192.0.2.2:5790 arrive, and it does not confirm the responses"
        )


@pytest.mark.parametrize(
    ("losses", "text"),
    [
        (((50, LOSSES - 1), (50, 0)), ""),
        (((50, LOSSES), (500, 49)), "10% from it to here"),
        (((0, 0), (10, 10)), "100% from here to it"),
        (((50, 10), (50, 20)), "20% from it to here and 40% from here to it"),
    ],
)
def test_loss_that_lasts_is_named_by_direction(losses: tuple[tuple[int, int], ...], text: str) -> None:
    """Few lost envelopes, a small share of many, and an outage that is over, are no problem."""
    daemon = Daemon()
    link = daemon.set_up(role="all", system_ids="all")
    link.note_losses(((50, 0), (50, 0)), NOW)
    for now in (NOW + 1.0, NOW + LOSS_LASTS_S - 0.1):
        assert daemon.findings(now) == {}
        link.note_losses(losses, now)
    findings = daemon.findings(NOW + LOSS_LASTS_S)
    assert set(findings) == ({"high_loss"} if text else set())
    assert not text or findings["high_loss"].text == f"many datagrams are lost: {text}"
    link.note_losses(((50, 0), (50, 0)), NOW + LOSS_LASTS_S)
    assert daemon.findings(NOW + LOSS_LASTS_S) == {}
