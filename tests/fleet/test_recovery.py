"""A lost laptop: the paper copy with what members have, restores the fleet."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import pytest

from tests.fleet.conftest import Say
from tests.fleet.folders import create, loaded
from uavlinkd.authority.trust import BulletinVerdict, Trust
from uavlinkd.fleet.authority_key import load_key, paper_copy
from uavlinkd.fleet.manifest import Fleet, read_manifest, toml_text
from uavlinkd.fleet.recovery import SERIALS_LEFT_OUT
from uavlinkd.system.addresses import Address


@pytest.fixture
def lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Fleet, str]:
    """The fleet and the paper copy, after its folder was lost. The configurations are on their machines."""
    monkeypatch.chdir(tmp_path)
    create(tmp_path / "fleet", drones=2, stations=1, relays=(Address("relay.example.org", 5790),))
    fleet = read_manifest(tmp_path / "fleet")
    paper = paper_copy(load_key(tmp_path / "fleet" / "authority.pem", pytest.fail))
    relay = loaded(tmp_path / "fleet", "relay")
    assert relay.fleet is not None
    trust = Trust(relay.fleet.authority, relay.public_key, relay.fleet.own.data, relay.fleet.bulletin)
    for member in fleet.members:
        if member.public_key != relay.public_key:
            trust.hold(member.public_key, member.signed)
    (tmp_path / "members.toml").write_text(toml_text(trust.known()))
    shutil.copy(tmp_path / "fleet" / "drone1" / "drone1.toml", tmp_path)
    shutil.rmtree(tmp_path / "fleet")
    return fleet, paper


RESTORE = "fleet restore --no-passphrase"


def test_paper_and_members_restore_a_fleet(lost: tuple[Fleet, str], say: Say, tmp_path: Path) -> None:
    """All members that a running one knows can be revoked by name, and new ones get serials that none has."""
    fleet, paper = lost
    said = say(RESTORE, paper)
    assert said.startswith("refused: fleet has no fleet.toml")
    assert "--member" in said
    say(f"{RESTORE} --member drone1.toml --member members.toml", paper)
    restored = read_manifest(tmp_path / "fleet")
    assert {member.name for member in restored.members} == {member.name for member in fleet.members}
    assert restored.contacts_of("v9") == fleet.contacts_of("v9")
    assert restored.bulletin == fleet.bulletin
    line = say("fleet sign --id 9", say("enroll v9"))
    assert len(line) > 500
    assert read_manifest(tmp_path / "fleet").member("v9").certificate.serial == 5 + SERIALS_LEFT_OUT - 1
    say("fleet remove drone2")
    after = read_manifest(tmp_path / "fleet")
    trust = Trust(fleet.authority, fleet.members[0].public_key, fleet.members[0].signed, fleet.published)
    assert trust.receive_bulletin(after.published)[0] is BulletinVerdict.NEWER
    assert trust.bulletin.refuses(fleet.member("drone2").certificate.serial)


def test_one_configuration_is_enough_to_sign(lost: tuple[Fleet, str], say: Say, tmp_path: Path) -> None:
    """Its contacts are known; its own key and other vehicles are not, and their serials are not used again."""
    fleet, paper = lost
    said = say(f"{RESTORE} --member drone1.toml", paper)
    assert "Members that are missing here go on flying" in said
    restored = read_manifest(tmp_path / "fleet")
    assert {member.name for member in restored.members} == {"relay", "ground-station"} & {
        contact.name for contact in fleet.contacts_of("drone1")
    }
    assert restored.next_serial > SERIALS_LEFT_OUT
    assert say("fleet sign --id 9", say("enroll v9"))


def test_sources_that_do_not_fit_are_refused(lost: tuple[Fleet, str], say: Say, tmp_path: Path) -> None:
    """Forged parts, another fleet's, no fleet's, and a paper copy of another authority: nothing is written."""
    _, paper = lost
    create(tmp_path / "other", drones=1, relays=(Address("relay.example.org", 5790),))
    known = tomllib.loads((tmp_path / "members.toml").read_text())
    known["contact"][0]["public_key"] = known["contact"][1]["public_key"]
    (tmp_path / "forged.toml").write_text(toml_text(known))
    (tmp_path / "other.toml").write_text("[1]")
    other = Path("other", "drone1", "drone1.toml")
    for sources, reason in (
        ("--member forged.toml", "damaged, or not signed"),
        (f"--member members.toml --member {other}", "damaged, or not signed by one"),
        (f"--member {other}", "another authority"),
        ("--member other.toml", "neither a member's configuration"),
        ("--member none.toml", "cannot be read"),
    ):
        assert reason in say(f"{RESTORE} {sources}", paper), sources
    assert not (tmp_path / "fleet" / "fleet.toml").exists()
