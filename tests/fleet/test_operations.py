"""Fleets on disk: the files that the commands write, and those after a failure; two commands at once."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.fleet.folders import create, join, loaded, renew, unasked
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError, Request
from uavlinkd.config import keys
from uavlinkd.fleet import operations
from uavlinkd.fleet.authority_key import AUTHORITY_FILE
from uavlinkd.fleet.files import reply_for
from uavlinkd.fleet.manifest import Fleet, parse_addresses, read_manifest
from uavlinkd.fleet.operations import lock
from uavlinkd.fleet.signing import Identity
from uavlinkd.system import folders
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import to_base64

AT = Address("relay.example.org", 5790)
RELAY = Identity(MemberRole.RELAY, None, (Address("198.51.100.9", 5790),))


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def refused(folder: Path, reason: str) -> Iterator[None]:
    """A command fails with this reason, and changes nothing."""
    before = snapshot(folder)
    with pytest.raises(FleetError, match=reason):
        yield
    assert snapshot(folder) == before


def check_fleet(folder: Path) -> Fleet:
    """Load every member, check its contacts, and return the fleet."""
    fleet = read_manifest(folder)
    for member in fleet.current:
        config = loaded(folder, member.name)
        assert config.public_key == member.public_key
        assert config.fleet is not None
        assert config.fleet.own.certificate == member.certificate
        contacts = [contact.key for contact in config.fleet.contacts]
        assert contacts == [contact.public_key for contact in fleet.contacts_of(member.name)]
    return fleet


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fleet of a relay, a ground station, three drones and an observer."""
    folder = tmp_path / "fleet"
    create(folder, drones=3, stations=1, observers=1, relays=(AT,))
    return folder


def test_every_daemon_accepts_a_new_fleet(folder: Path) -> None:
    """Each configuration loads without a warning, and names no member but the relay. Keys are in one file each."""
    fleet = check_fleet(folder)
    names = ["relay", "ground-station", "drone1", "drone2", "drone3", "observer"]
    assert [member.name for member in fleet.members] == names
    assert [member.ids for member in fleet.members] == ["-", "255", "1", "2", "3", "254"]
    files = snapshot(folder)
    assert list(map(str, loaded(folder, "relay").listen)) == ["0.0.0.0:5790", "[::]:5790"]
    for member in fleet.members:
        assert loaded(folder, member.name).warnings == ()
        of = {
            path.split("/")[0] for path, content in files.items() if to_base64(member.public_key).encode() in content
        }
        assert of - {"fleet.toml"} == ({*names[1:]} if member.name == "relay" else set())
        key = (folder / member.name / f"{member.name}.key").read_bytes().strip()
        assert [path for path, content in files.items() if key in content] == [f"{member.name}/{member.name}.key"]
    secret = [*folder.rglob("*.key"), folder / AUTHORITY_FILE]
    assert {path.stat().st_mode & 0o777 for path in secret} == {0o600}


def test_ground_station_stands_in_for_a_relay(tmp_path: Path) -> None:
    """The first one with an address is the contact of all others, and relays. The next one is a contact too."""
    folder = tmp_path / "fleet"
    create(folder, drones=2, stations=2, at=(Address("10.13.0.254", 5790), Address("10.13.0.253", 5790)))
    renew(folder, "ground-station1")
    fleet = check_fleet(folder)
    assert [member.relays for member in fleet.members] == [True, False, False, False]
    assert [member.name for member in fleet.contacts_of("drone1")] == ["ground-station1", "ground-station2"]
    station = loaded(folder, "ground-station1")
    assert station.relay_server is not None
    assert list(map(str, station.listen)) == ["0.0.0.0:5790"]


@pytest.mark.parametrize("damage", [b"\xff", b"[fleet", b"a = " + b"[" * 5000])
def test_damaged_manifest_is_refused(tmp_path: Path, damage: bytes) -> None:
    """The error names the file. Brackets can be nested too deeply for the parser."""
    (tmp_path / "fleet.toml").write_bytes(damage)
    with pytest.raises(FleetError, match=r"fleet\.toml is not valid TOML"):
        read_manifest(tmp_path)


def test_manifest_of_an_earlier_version(folder: Path) -> None:
    """Settings that are gone have no effect. Without an authority, the message says what becomes of the members."""
    path, fleet = folder / "fleet.toml", read_manifest(folder)
    path.write_text(path.read_text().replace("[fleet]\n", '[fleet]\nsuccessor = "AAAA"\ncontrol_socket = "a.sock"\n'))
    assert read_manifest(folder) == fleet
    path.write_text('[fleet]\naddress_plan = "none"\npsk = true\n')
    with pytest.raises(FleetError, match=r"without an authority\. Its members work as before"):
        read_manifest(folder)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("next_serial = 7", "next_serial = 6"),
        ("system_ids = [1, 1]", "system_ids = [7, 7]"),
        ("relays = true", "relays = 1"),
        ('role = "observer"', 'role = "operator"'),
        ("swarm = false", 'swarm = "no"'),
        ('suite = "x25519"', 'suite = "rot13"'),
        ("[[member]]", "[[peer]]"),
        ('bulletin = "A', 'bulletin = "B'),
        ("relay.example.org:5790", "relay.example.org:0"),
    ],
)
def test_altered_manifest_is_refused(folder: Path, old: str, new: str) -> None:
    """What the authority signed counts: the facts beside a certificate are for persons."""
    path = folder / "fleet.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FleetError):
        read_manifest(folder)


def test_impossible_fleets_are_refused(tmp_path: Path) -> None:
    """With the reason, and nothing is written. An existing fleet is not changed."""
    with pytest.raises(FleetError, match=r"suite .* does not exist: use one of x25519"):
        operations.init(tmp_path / "fleet", "rot13", None)
    assert list(tmp_path.iterdir()) == []
    create(tmp_path / "fleet")
    with refused(tmp_path, "exists already"):
        create(tmp_path / "fleet")


def test_signed_request_is_in_the_manifest_before_its_line_is_printed(folder: Path) -> None:
    """The same request again changes nothing, and gets the same certificate."""
    request = Request("v7", keys.decode_key(keys.public_key_text(keys.generate_private_key())))
    _, fleet = operations.sign(folder, request, Identity(ids=(70, 79)), unasked)
    assert fleet == read_manifest(folder)
    assert fleet.member("v7").ids == "70-79"
    assert operations.line_of(fleet, "v7") == reply_for(fleet, fleet.member("v7")).line()
    assert operations.sign(folder, request, Identity(), unasked) == (fleet, fleet)
    with refused(folder, "already"):
        operations.sign(folder, request, Identity(ids=(7, 7)), unasked)
    _, fleet = operations.revoke(folder, "v7", unasked)
    assert operations.revoke(folder, "v7", unasked) == (fleet, fleet)
    with refused(folder, "v7 was revoked, as serial 7: .* --replace v7"):
        operations.sign(folder, request, Identity(), unasked)
    with refused(folder, "is that of v7, which is revoked"):
        operations.sign(folder, request, Identity(), unasked, replaces=True)


def test_key_of_another_authority_is_refused(folder: Path, tmp_path: Path) -> None:
    """It would sign what no member accepts."""
    create(tmp_path / "other")
    shutil.copyfile(tmp_path / "other" / AUTHORITY_FILE, folder / AUTHORITY_FILE)
    with refused(folder, "is the key of another fleet's authority"):
        operations.revoke(folder, "drone1", unasked)


def test_values_of_the_user_are_kept(folder: Path) -> None:
    """When contacts and its own key change. The file is written whole, without comments."""
    path = folder / "drone1" / "drone1.toml"
    text = path.read_text().replace("[fleet]\n", '[fleet]  # ours\ndeny = ["drone9",\n  "drone8"]\n')
    path.write_text(text.replace("confidential = true", "confidential = false  # amateur radio"))
    rates = '\n[[fleet_role]]\nname = "vehicle"\n[fleet_role.rate_in]\n"ATTITUDE" = 2.5\n'
    path.write_text(path.read_text() + rates + "[log]\nlevel = 'warning'  # quiet\n")
    before = tomllib.loads(path.read_text())
    join(folder, "other", RELAY)
    join(folder, "drone1", replaces=True)
    operations.revoke(folder, "relay", unasked)
    renew(folder, "drone1")
    after = tomllib.loads(path.read_text())
    assert after["fleet"].pop("deny") == ["drone9", "drone8"]
    assert [contact["addresses"] for contact in after.pop("contact")] == [["198.51.100.9:5790"]]
    assert set(after.pop("fleet")) == {"authority", "certificate", "bulletin"}
    assert after.pop("private_key_file") == "drone1.2.key"
    kept = ("fleet", "contact", "private_key_file")
    assert after == {key: value for key, value in before.items() if key not in kept}
    assert "#" not in path.read_text().partition("\n\n")[2]


def test_addresses_that_a_person_added_to_a_contact_are_kept(folder: Path) -> None:
    """A URL, and an address on one network, which replaces the signed one; also with a new key of the contact.

    URLs that the authority signed replace it.
    """
    path = folder / "drone1" / "drone1.toml"
    url, place = "wss://relay.example.org:443/uavlink", {"address": "relay.example.org:5790", "network": "lte"}
    own = f'addresses = [{{ address = "relay.example.org:5790", network = "lte" }}, "{url}"]'
    network = '\n[[network]]\nname = "lte"\ninterface = "wwan0"\n'
    path.write_text(path.read_text().replace('addresses = ["relay.example.org:5790"]', own) + network)
    join(folder, "relay", replaces=True)
    renew(folder, "drone1")
    contact = tomllib.loads(path.read_text())["contact"][0]
    assert contact["addresses"] == [place, url]
    assert [str(one) for one in read_manifest(folder).member("relay").addresses] == ["relay.example.org:5790"]
    texts = ["relay.example.org:5790", "wss://relay.example.org:8443/other"]
    join(folder, "relay", Identity(None, None, parse_addresses("--address", texts)), replaces=True)
    renew(folder, "drone1")
    contact = tomllib.loads(path.read_text())["contact"][0]
    assert contact["addresses"] == [texts[1], place]
    path.write_text(path.read_text().replace(contact["certificate"], "AQAB"))
    renew(folder, "drone1")
    assert tomllib.loads(path.read_text())["contact"][0]["addresses"] == texts


def test_url_of_a_relay_reaches_the_members(tmp_path: Path) -> None:
    """As `--address` names it behind the relay's address. Another relay does not get it: it would not use it."""
    folder, url = tmp_path / "fleet", "wss://relay.example.org:443/uavlink"
    create(folder)
    join(folder, "relay", Identity(MemberRole.RELAY, None, parse_addresses("--address", [str(AT), url])))
    join(folder, "relay2", RELAY)
    join(folder, "drone1")
    for name, addresses in (("drone1", [str(AT), url]), ("relay2", [str(AT)])):
        assert tomllib.loads((folder / name / f"{name}.toml").read_text())["contact"][0]["addresses"] == addresses
    assert list(map(str, loaded(folder, "relay").listen)) == ["0.0.0.0:5790", "[::]:5790"]
    relay = loaded(folder, "drone1").relays[0]
    assert [str(address) for address in relay.addresses] == [str(AT), url]


def test_members_whose_contacts_changed_are_named(folder: Path) -> None:
    """Each needs a new line: nobody changes its file."""
    before = read_manifest(folder)
    join(folder, "other", RELAY)
    names = ["drone1", "drone2", "drone3", "ground-station", "observer", "relay"]
    assert read_manifest(folder).with_other_contacts(before) == names
    before = read_manifest(folder)
    join(folder, "v7")
    assert read_manifest(folder).with_other_contacts(before) == []


def test_failed_write_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full: neither the manifest nor a part of it is written, nor a new fleet."""

    def fail(_: Path, __: bytes) -> None:
        raise OSError(28, "No space left on device", "fleet.toml")

    monkeypatch.setattr(folders, "write_new", fail)
    with refused(folder, "No space left"):
        operations.revoke(folder, "drone1", unasked)
    with refused(folder.parent, "No space left"):
        create(folder.parent / "another")


def test_second_command_is_refused(folder: Path) -> None:
    """While another one has the lock: neither overwrites the other's change."""
    with lock(folder), refused(folder, "another fleet command runs"):
        operations.revoke(folder, "drone1", unasked)
    operations.revoke(folder, "drone1", unasked)
