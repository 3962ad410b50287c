"""UDP that is blocked is not a relay that is off: other answers and ICMP messages show the difference."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.observe.test_findings import NOW, Daemon
from tests.protocol.harness import PLAIN
from uavlinkd.config.model import PeerAddress, RelayConfig
from uavlinkd.daemon.peer_link import LOSSES, NOT_ANSWERING_S, PeerLink
from uavlinkd.observe.facts import Moment
from uavlinkd.observe.finding import Finding, Severity
from uavlinkd.observe.findings import find
from uavlinkd.observe.traffic_signs import LOSS_LASTS_S
from uavlinkd.protocol.outputs import PeerClosed
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.relay.client_link import RelayHandles, RelayLink
from uavlinkd.system.addresses import Address

FIRST, SECOND = ("203.0.113.1", 5790), ("203.0.113.2", 5790)
LATER = NOT_ANSWERING_S


class Member(Daemon):
    """A daemon with the peer drone1, which it reaches along relays."""

    def __init__(self) -> None:
        super().__init__()
        self.link.set_paths([], 0.0)
        self.relays: dict[str, RelayLink] = self.parts.relay_links
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
    assert "it is off, its address is wrong, keys or suites differ, or a firewall drops UDP" in finding.text
    assert "this daemon must be a member there" in finding.remedy


URL = "wss://one:443/uavlink"


def test_relay_that_does_not_answer_by_tls_either(member: Member) -> None:
    member.add_relay("one", FIRST)
    member.parts.tls = SimpleNamespace(states=lambda addresses: {URL: "ECONNREFUSED"})
    finding = member.only()
    assert f": by TLS ({URL}) no process listens there now (ECONNREFUSED); by UDP it is off" in finding.text
    assert finding.remedy.startswith("start it, or correct the port; or start one, and open its firewall")


@pytest.mark.parametrize(
    ("state", "text", "remedy"),
    [
        ("http_404", "a web server answers there, but not for this path (http_404)", "correct the URL, or"),
        ("proxy_407", "the proxy wants a name and password (proxy_407)", "write HTTPS_PROXY="),
        ("TimeoutError", "no answer in time (TimeoutError)", "open TCP port 443 at the relay"),
        ("connected", "it is connected, and gets no answer (silent)", "compare the public_key of the"),
        ("not connected", "not connected", "start one, and open its firewall"),
    ],
)
def test_relay_with_a_url_alone(member: Member, state: str, text: str, remedy: str) -> None:
    """The finding names why it is not reached by TLS, and says nothing about UDP."""
    relay = member.add_relay("one")
    relay.set_paths([Path(7, (URL, 0))], 0.0)
    member.parts.tls = SimpleNamespace(states=lambda addresses: {URL: state})
    assert member.findings(LATER - 0.1) == {}
    finding = member.only()
    assert (finding.cause, finding.severity) == ("relay_not_answering", Severity.FAULT)
    assert finding.text.endswith(f": by TLS ({URL}) {text}")
    assert finding.remedy.startswith(remedy)
    other = member.add_relay("two", FIRST)
    texts = [one.text for one in member.findings(LATER).values()]
    assert len(texts) == 1, "relays on two hosts, of which one has no address for UDP, show nothing about UDP"
    assert other in Moment(member.parts, member.history, LATER).silent_relays


def test_icmp_messages_are_answers(member: Member) -> None:
    """UDP gets out, and a message comes back, for some seconds after it."""
    member.add_relay("one", FIRST)
    member.add_relay("two", SECOND)
    for error, place in (("ECONNREFUSED", FIRST), ("EHOSTUNREACH", SECOND)):
        member.evidence.add_error(f"icmp_{error}", place, LATER)
    texts = [one.text for one in find(member.parts, member.history, LATER)]
    assert "203.0.113.1:5790: no process listens there now (ECONNREFUSED, ICMP)" in texts[0]
    assert "203.0.113.2:5790: no machine answers at the address (EHOSTUNREACH, ICMP)" in texts[1]
    assert all(
        "a firewall drops UDP here or there" in one.text for one in find(member.parts, member.history, LATER + 6.0)
    )


def test_a_relay_that_no_peer_needs_is_a_warning(member: Member) -> None:
    """Of the daemon, not of the peer."""
    member.answers(member.link, SECOND)
    member.add_relay("one", FIRST)
    finding = member.only()
    assert (finding.cause, finding.severity, finding.name) == ("relay_not_answering", Severity.WARNING, "")


def test_a_relay_that_answered_before(member: Member) -> None:
    """It has its keys right."""
    relay = member.add_relay("one", FIRST)
    relay.peer.received_at = 0.0
    assert "it did before, so it is off, or UDP to it or back is blocked" in member.only().text
    assert member.only().remedy == (
        "start one, and open its firewall and its provider's; `uavlinkd status` there names other causes"
    )


def test_a_peer_that_is_not_bound_may_not_reach_the_relay(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor may it be on."""
    relay = member.add_relay("one", FIRST)
    monkeypatch.setattr(relay, "state_for", lambda _: "waiting")
    member.answers(relay, FIRST)
    assert member.only().text.startswith(
        "drone1 is not bound at the relay one: it is off, or cannot reach the relay (UDP"
    )


def test_known_reasons_do_not_look_like_a_firewall(member: Member) -> None:
    """An error of this machine, and a name without an address."""
    member.add_relay("two", SECOND)
    member.evidence.add_error("EPERM", SECOND, 1.0)
    assert "firewall, or the service's unit, does not permit it (EPERM)" in member.only().text
    assert member.only().remedy == "see `sudo nft list ruleset` here", "the certain cause alone"
    member.sockets.unresolved = lambda name: {"b.test"}
    assert (
        "b.test has no address now"
        in {one.cause: one for one in find(member.parts, member.history, LATER)}["relay_not_answering"].text
    )


def test_a_peer_that_was_up_and_is_silent(member: Member, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as it is lost: nothing arrives, and what may differ was right before."""
    member.link.peer.received_at = LATER
    assert member.findings(2 * LATER - 0.1) == {}
    text = member.only(2 * LATER).text
    assert text.startswith("no answer from it any more: it is off, out of range, or a firewall drops UDP")
    relay = member.add_relay("one", FIRST)
    monkeypatch.setattr(relay, "state_for", lambda _: "bound")
    member.answers(relay, FIRST)
    assert member.only(2 * LATER)[4:] == (
        "no answer from it any more through the relay one, which answers: it is off, or has no network",
        "it comes back by itself; look at its power and its network",
    )


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
    assert "no answer from it through the relay one, which answers: " in member.only(9.0).text
    relay.peer.is_up = False
    relay.on_event(PeerClosed(relay.peer), 9.0)
    assert member.only(9.0).cause == "no_answer"
    assert member.only(9.0 + LATER).cause == "relay_not_answering"


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
