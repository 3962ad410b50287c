"""The findings about a fleet with an authority: each cause with its subject and remedy."""

from __future__ import annotations

import asyncio
from base64 import b64decode, b64encode
from dataclasses import replace
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.config.files import KEY
from tests.config.fleets import OTHER_SIGNER, bulletin, certificate, contact, fleet, load_member, member_file
from tests.daemon.test_evidence import THERE
from tests.observe.test_findings import NOW, STRANGER, Daemon
from tests.protocol.harness import PLAIN
from uavlinkd.authority import state_file
from uavlinkd.authority.certificates import MemberRole, digest_of
from uavlinkd.authority.constants import CONTACTS_FIRST_S, HAVE_INTERVAL_S
from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import RelayConfig
from uavlinkd.daemon.peer_link import NOT_ANSWERING_S
from uavlinkd.fleet.members import EVENT_S, FleetMembers
from uavlinkd.observe.facts import Moment
from uavlinkd.observe.finding import Severity, Subject
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.outputs import Dropped, RecordReceived
from uavlinkd.protocol.path import SERIAL_HOST
from uavlinkd.protocol.path import Path as NetPath
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Have
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.relay.client_link import RelayHandles, RelayLink

C, D = (b64decode(KEY[name]) for name in ("c", "d"))


class Member(Daemon):
    """Vehicle 7, which has the pinned peer drone1 and the contact gs. Its bulletin has the number 2."""

    def __init__(
        self, folder: Path, *, news: str = "", more: str = "", contacts: str = "", relay: Any = None
    ) -> None:
        super().__init__()
        self.set_up(role="all", system_ids="all")
        self.config = load_member(folder, member_file(fleet(more=more, news=news or bulletin(2)) + contacts))
        assert self.config.fleet is not None
        self.relays: dict[str, Any] = {}
        shell = SimpleNamespace(by_name=self.relays)
        parts = SimpleNamespace(
            config=self.config,
            node=self.node,
            links=self.links,
            relays=shell,
            relay=relay,
            evidence=self.evidence,
            line=SimpleNamespace(perform=lambda outputs: None),
        )
        self.fleet = FleetMembers(cast(Any, parts), self.config.fleet)
        self.membership: Any = SimpleNamespace()
        self.fleet.peers = cast(Any, self.membership)
        self.parts.fleet = self.fleet
        self.key = self.link.key
        self.fleet.exchange.on_handshake(self.key, NOW)
        self.orders = 0

    def record(self, record: FleetRecord) -> DropReason | None:
        """The pinned peer sends it."""
        self.orders += 1
        received = RecordReceived(self.link.peer, NetPath(0, THERE), record, self.orders)
        return self.fleet.on_record(received, self.now)

    def have(self, number: int, data: str, serial: int = 0) -> None:
        self.record(Have(number, digest_of(b64decode(data)), serial, 0))

    def shows(self, key: bytes, signed: str) -> None:
        """An initiation shows this certificate, from an unknown address."""
        with pytest.raises(Drop) as drop:
            self.fleet.judge(key, b64decode(signed), self.now)
        refused = Dropped(drop.value.reason, None, NetPath(0, STRANGER), 1, drop.value.detail)
        self.evidence.add_dropped(refused, self.now)


async def test_a_fleet_without_problems_has_none(tmp_path: Path) -> None:
    """A contact that is accepted, a peer with the same bulletin."""
    member = Member(tmp_path, contacts=contact())
    member.have(2, bulletin(2), serial=9)
    assert member.findings() == {}


async def test_members_that_are_refused_are_named(tmp_path: Path) -> None:
    """With their serials and addresses. A sender without a name has its key; other refusals are only counted."""
    member = Member(tmp_path, news=bulletin(2, 9), more='operator = "pinned"')
    member.shows(C, certificate(name="v9", ids=(9, 9), key=KEY["c"], serial=9))
    member.shows(D, certificate(name="v8", ids=(8, 8), key=KEY["c"]))
    member.shows(C, certificate(name="v8", ids=(7, 7), key=KEY["c"], serial=11))
    member.shows(C, certificate(MemberRole.OPERATOR, "gs", (255, 255), key=KEY["c"], serial=12))
    texts = {cause: finding.text for cause, finding in member.findings().items()}
    at = "at 198.51.100.7:5790"
    assert set(texts) == {"certificate_revoked", "bad_certificate"}
    assert texts["certificate_revoked"].endswith(f": v9 (serial 9) {at}")
    assert texts["bad_certificate"].endswith(f"of {KEY['d']} {at}")
    assert member.findings(NOW + 31) == {}


async def test_unknown_key_is_not_of_the_member_at_its_address(tmp_path: Path) -> None:
    """One NAT may have both. A sender that another finding names, and a member that restarted, are not repeated."""
    member, tablet = Member(tmp_path, news=bulletin(2, 9)), bytes([9]) * 32
    member.link.config = replace(member.link.config, settings=replace(member.link.config.settings, is_certified=True))
    member.shows(C, certificate(name="v9", ids=(9, 9), key=KEY["c"], serial=9))
    member.fleet.trust.hold(D, b64decode(certificate(name="v8", ids=(8, 8), key=KEY["d"], serial=8)))
    member.dropped(DropReason.UNKNOWN_PEER, STRANGER, C)
    assert set(member.findings()) == {"certificate_revoked"}
    member.now, member.link.peer.is_up = NOW + 1, False
    for key in (D, tablet):
        member.dropped(DropReason.UNKNOWN_PEER, THERE, key)
    member.dropped(DropReason.BAD_MAC1, THERE)
    findings = member.findings()
    assert set(findings) == {"certificate_revoked", "not_a_member", "wrong_key_there"}
    assert findings["not_a_member"].text.endswith(f"no member here: {encode_key(tablet)} at 192.0.2.2:5790")
    assert "`uavlinkd enroll`" in findings["not_a_member"].remedy
    assert "`uavlinkd fleet sign drone1`" in findings["wrong_key_there"].remedy


async def test_first_second_of_a_start(tmp_path: Path) -> None:
    """Only contacts are accepted; at a relay also members that carry no frames to it."""
    member = Member(tmp_path, more='operator = "pinned"', contacts=contact(), relay=SimpleNamespace())
    now, vehicle = monotonic(), b64decode(certificate(name="v9", ids=(9, 9), key=KEY["c"], serial=9))
    with pytest.raises(Drop) as drop:
        member.fleet.judge(C, vehicle, now)
    assert drop.value.reason is DropReason.BULLETIN_AWAITED
    operator = certificate(MemberRole.OPERATOR, "tablet", (250, 250), key=KEY["d"], serial=12)
    assert member.fleet.judge(D, b64decode(operator), now).name.endswith("tablet")
    assert member.fleet.judge(C, vehicle, now + CONTACTS_FIRST_S).name == "v9"


async def test_own_key_with_a_certificate_elsewhere(tmp_path: Path) -> None:
    """A second machine has this daemon's key and shows its certificate."""
    member = Member(tmp_path)
    member.shows(member.config.public_key, certificate())
    member.evidence.add_dropped(
        Dropped(DropReason.BAD_CERTIFICATE, None, NetPath(0, STRANGER), 1, bytes([7]) * 32), NOW
    )
    assert "own_key_elsewhere" in member.findings()


async def test_introduction_that_is_refused_is_shown(tmp_path: Path) -> None:
    """A relay names a revoked member, and one whose role has no policy. Other peers cannot."""
    member = Member(tmp_path, news=bulletin(2, 9), more='operator = "pinned"')
    revoked = certificate(name="v9", ids=(9, 9), key=KEY["c"], serial=9)
    assert member.record(CertificateRecord(C, b64decode(revoked))) is DropReason.UNEXPECTED_RECORD
    member.relays["drone1"] = SimpleNamespace(config=member.link.config)
    assert member.record(CertificateRecord(C, b64decode(revoked))) is DropReason.CERTIFICATE_REVOKED
    other = certificate(MemberRole.OPERATOR, "gs", (255, 255), key=KEY["c"], serial=12)
    assert member.record(CertificateRecord(C, b64decode(other))) is DropReason.ROLE_NOT_ACCEPTED
    assert set(member.findings()) == {"certificate_revoked"}


async def test_key_of_small_order_is_not_introduced(tmp_path: Path) -> None:
    """The holder of a stolen authority's key can sign for it. An initiation to it would raise."""
    member = Member(tmp_path)
    member.relays["drone1"] = SimpleNamespace(config=member.link.config)
    key = bytes([1, *bytes(31)])
    signed = certificate(name="v9", ids=(9, 9), key=b64encode(key).decode(), serial=9)
    assert member.record(CertificateRecord(key, b64decode(signed))) is DropReason.BAD_CERTIFICATE
    assert member.node.find(key) is None


async def test_bulletins_that_contradict_each_other(tmp_path: Path) -> None:
    """Each names the peer. They last for ten minutes, or until a bulletin ends them."""
    member = Member(tmp_path, news=bulletin(2, 9))
    member.have(2, bulletin(2, 9))
    member.have(1, bulletin(1))
    member.have(2, bulletin(2, 8))
    assert member.record(BulletinRecord(b64decode(bulletin(3, 8)))) is None
    findings = member.findings()
    assert {cause: finding.severity for cause, finding in findings.items()} == {
        "bulletin_conflict": Severity.SECURITY,
        "bulletin_rolled_back": Severity.WARNING,
    }
    assert all(finding.text.startswith("drone1 ") for finding in findings.values())
    assert member.findings(NOW + EVENT_S) == {}


async def test_revoked_here_and_elsewhere(tmp_path: Path) -> None:
    """This daemon, which explains its silent relay, and a pinned peer, which stays; a bulletin that is too old."""
    member = Member(tmp_path, news=bulletin(2, 2, 7, 9), more="require_bulletin = 3", contacts=contact())
    config = RelayConfig(PeerSettings("relay vps", C, None, PLAIN, is_certified=True), ())
    relay = RelayLink(config, member.node, RelayHandles(), lambda *_: None, NOW - NOT_ANSWERING_S)
    relay.set_paths([NetPath(0, THERE)], 0.0)
    member.parts.relay_links["vps"] = relay
    member.sockets.unresolved = lambda name: set[str]()
    assert Moment(member.parts, member.history, NOW).silent_relays == [relay]
    member.have(2, bulletin(2, 2, 7, 9), serial=9)
    findings = member.findings()
    assert set(findings) == {
        *("own_certificate_revoked", "bulletin_awaited", "revoked_but_pinned"),
    }
    assert "revokes the certificate of this daemon (serial 7)" in findings["own_certificate_revoked"].text
    assert findings["revoked_but_pinned"].subject is Subject.PEER
    assert "(serial 9)" in findings["revoked_but_pinned"].text


async def test_state_that_cannot_be_written(tmp_path: Path) -> None:
    """The bulletin counts anyway. The state is written again until that succeeds."""
    member = Member(tmp_path)
    assert member.config.fleet is not None
    file = member.config.fleet.state_file
    file.with_name(f".{file.name}.new").mkdir()
    assert member.fleet.publish(bulletin(3), NOW)["verdict"] == "newer"
    await until_written(member.fleet)
    finding = member.findings()["fleet_state_degraded"]
    assert finding.text.startswith(f"{file} cannot be written: Is a directory: ")
    file.with_name(f".{file.name}.new").rmdir()
    member.fleet.do_due(monotonic() + HAVE_INTERVAL_S)
    await until_written(member.fleet)
    assert member.findings() == {}
    assert state_file.read(file, member.fleet.trust) == ""


async def test_state_that_cannot_be_used(tmp_path: Path) -> None:
    """That of another fleet counts as absent and is replaced, and a finding says why until a bulletin comes."""
    foreign = state_file.FleetState(b64decode(bulletin(5, signer=OTHER_SIGNER)))
    state_file.write(tmp_path / "drone0.fleet-state", foreign)
    member = Member(tmp_path)
    await until_written(member.fleet)
    text = member.findings()["fleet_state_degraded"].text
    assert "drone0.fleet-state has a bulletin of another fleet" in text
    member.fleet.publish(bulletin(3), NOW)
    await until_written(member.fleet)
    assert member.findings() == {}


async def until_written(fleet: FleetMembers) -> None:
    """The thread has written the state, or could not."""
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    await asyncio.gather(*tasks)


async def test_bulletin_is_repeated_when_a_slow_radio_had_the_time_for_an_answer(tmp_path: Path) -> None:
    """Otherwise the same bulletin would take the time of heartbeats again, just before its answer comes."""
    member, line = Member(tmp_path), NetPath(1, (SERIAL_HOST, 0))
    member.node.facts.set_budgets({line.socket: 1_600})
    member.node.set_paths(member.link.peer, [line], NOW)
    member.link.peer.paths.best = member.link.peer.paths.find(line)
    member.have(1, bulletin(1))
    exchange = member.fleet.exchange
    assert any(isinstance(record, BulletinRecord) for _, record in exchange.do_due(NOW))
    assert exchange.next_at == NOW + member.node.facts.repeat_s(line, len(b64decode(bulletin(2)))) > NOW + 1.5
