"""Fleets on disk: the files that the commands write, and those after a failure; two commands at once; templates."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.vehicles import NAMES, create, loaded, unasked
from tests.waiting import PATIENCE_S
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError, Request
from uavlinkd.config import keys
from uavlinkd.config.model import ConfigError
from uavlinkd.fleet import operations, transaction
from uavlinkd.fleet.authority_key import AUTHORITY_FILE, SUCCESSOR_FILE
from uavlinkd.fleet.files import reply_for
from uavlinkd.fleet.manifest import Fleet, FleetSettings, parse_addresses, read_manifest, toml_text
from uavlinkd.fleet.signing import Identity
from uavlinkd.fleet.transaction import lock
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import to_base64

COMMAND = end_with_parent(sys.executable, "-m", "uavlinkd", "fleet", "add", "scout", "--out", "fleet")
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
    """Load every member that is here, check its contacts, and return the fleet."""
    fleet = read_manifest(folder)
    for member in fleet.current:
        if (folder / member.name / f"{member.name}.toml").exists():
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
    create(folder, drones=3, stations=1, observers=1, relays=(Address("relay.example.org", 5790),))
    return folder


def test_every_daemon_accepts_a_new_fleet(folder: Path) -> None:
    """Each configuration loads without a warning, and names no member but the relay."""
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


def test_ground_station_stands_in_for_a_relay(tmp_path: Path) -> None:
    """The first one with an address is the contact of all others, and relays."""
    create(tmp_path / "fleet", drones=2, stations=2, at=(Address("10.13.0.254", 5790), Address("10.13.0.253", 5790)))
    fleet = check_fleet(tmp_path / "fleet")
    assert [member.relays for member in fleet.members] == [True, False, False, False]
    assert [member.name for member in fleet.contacts_of("drone1")] == ["ground-station1", "ground-station2"]
    station = loaded(tmp_path / "fleet", "ground-station1")
    assert station.relay_server is not None
    assert list(map(str, station.listen)) == ["0.0.0.0:5790"]


def test_private_keys_are_in_their_own_folder_alone(folder: Path) -> None:
    """A private key is in one file, with mode 0600; the authority's and its successor's too."""
    files = snapshot(folder)
    for name in (*NAMES, "ground-station", "observer", "relay"):
        key = (folder / name / f"{name}.key").read_bytes().strip()
        assert [path for path, content in files.items() if key in content] == [f"{name}/{name}.key"]
    secret = [*folder.rglob("*.key"), folder / AUTHORITY_FILE, folder / SUCCESSOR_FILE]
    assert {path.stat().st_mode & 0o777 for path in secret} == {0o600}


@pytest.mark.parametrize("damage", [b"\xff", b"[fleet", b"a = " + b"[" * 5000])
def test_damaged_manifest_is_refused(tmp_path: Path, damage: bytes) -> None:
    """The error names the file. Brackets can be nested too deeply for the parser."""
    (tmp_path / "fleet.toml").write_bytes(damage)
    with pytest.raises(FleetError, match=r"fleet\.toml is not valid TOML"):
        read_manifest(tmp_path)


def test_manifest_of_an_earlier_version_is_refused(folder: Path) -> None:
    """The message says what becomes of its members."""
    (folder / "fleet.toml").write_text('[fleet]\naddress_plan = "none"\npsk = true\n')
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
        ("[[member]]", "[[peer]]"),
        ('bulletin = "A', 'bulletin = "B'),
        ("198", "1980"),
    ],
)
def test_altered_manifest_is_refused(folder: Path, old: str, new: str) -> None:
    """What the authority signed counts: the facts beside a certificate are for persons."""
    operations.add(folder, "other", RELAY, unasked)
    path = folder / "fleet.toml"
    text = path.read_text().replace("next_serial = 8", "next_serial = 7")
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FleetError):
        read_manifest(folder)


def test_fleet_is_made_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It appears at once, whole, and not if a configuration is not valid. An existing fleet is not changed."""
    at = (Address("10.13.0.254", 5790),)
    with pytest.raises(FleetError, match="not valid"):
        create(tmp_path / "a" / "b", FleetSettings(drone_url="nothing"), drones=2, stations=1, at=at)
    assert list((tmp_path / "a").iterdir()) == []
    rename, appeared = Path.rename, []

    def watch(path: Path, target: Path) -> Path:
        if target == tmp_path / "fleet":
            appeared.append(sorted(file.name for file in path.iterdir()))
        assert bool(appeared) or not (tmp_path / "fleet").exists()
        return rename(path, target)

    with monkeypatch.context() as watched:
        watched.setattr(Path, "rename", watch)
        create(tmp_path / "fleet", drones=1, stations=1, at=at)
    assert appeared == [["authority.pem", "drone1", "fleet.toml", "ground-station", "successor.pem"]]
    with refused(tmp_path, "exists already"):
        create(tmp_path / "fleet")


@pytest.mark.parametrize(
    ("settings", "counts", "reason"),
    [
        (FleetSettings(), {"drones": -1}, "at most 255"),
        (FleetSettings(), {"drones": 200, "stations": 56}, "at most 255"),
        (FleetSettings(), {"drones": 1}, r"drone1 would find no other member: a relay is needed \(init --relay"),
        (FleetSettings(), {"drones": 1, "stations": 1}, "ground-station would find no other member"),
        (FleetSettings(), {"at": (Address("10.13.0.254", 5790),)}, "more --station-address than --ground-stations"),
        (FleetSettings(suite="rot13"), {}, "suite .* does not exist: use one of x25519"),
    ],
)
def test_impossible_fleets_are_refused(
    tmp_path: Path, settings: FleetSettings, counts: dict[str, Any], reason: str
) -> None:
    """What cannot be is refused with its reason, and nothing is written."""
    with pytest.raises(FleetError, match=reason):
        create(tmp_path / "fleet", settings, **counts)
    assert list(tmp_path.iterdir()) == []


def test_added_member_changes_no_other_file(folder: Path) -> None:
    """The others learn of it from the relay."""
    before = snapshot(folder)
    result = operations.add(folder, "scout", Identity(), unasked)
    assert check_fleet(folder).member("scout").ids == "4"
    assert result.changed == ("scout",)
    after = snapshot(folder)
    assert {path for path in after if after[path] != before.get(path)} == {
        *("fleet.toml", "scout/scout.toml", "scout/scout.key")
    }


def test_signed_request_is_in_the_manifest_before_its_line_is_printed(folder: Path) -> None:
    """The same request again changes nothing, and gets the same certificate."""
    request = Request("v7", keys.decode_key(keys.public_key_text(keys.generate_private_key())))
    result, line = operations.sign(folder, request, Identity(ids=(70, 79)), unasked)
    fleet = read_manifest(folder)
    assert fleet == result.fleet
    assert fleet.member("v7").ids == "70-79"
    assert line == reply_for(fleet, fleet.member("v7")).line() == operations.line_of(folder, "v7")
    assert operations.sign(folder, request, Identity(), unasked) == (operations.Result(fleet), line)
    with refused(folder, "already"):
        operations.sign(folder, request, Identity(ids=(7, 7)), unasked)
    operations.revoke(folder, "v7", unasked)
    with refused(folder, "v7 was revoked, as serial 7: .* --replace v7"):
        operations.sign(folder, request, Identity(), unasked)
    with refused(folder, "is that of v7, which is revoked"):
        operations.sign(folder, request, Identity(), unasked, replaces=True)


def test_revoked_member_frees_its_name(folder: Path) -> None:
    """Its folder is kept; a new member may have its name and id, with another key."""
    operations.revoke(folder, "drone2", unasked)
    fleet = check_fleet(folder)
    assert fleet.bulletin.revoked == (4,)
    assert "drone2" not in [member.name for member in fleet.current]
    assert (folder / "drone2" / "drone2.key").exists()
    assert operations.revoke(folder, "drone2", unasked).fleet == fleet
    with refused(folder, "drone2 is revoked"):
        operations.add(folder, "drone2", Identity(), unasked, replaces=True)
    (folder / "drone2").rename(folder / "away")
    operations.add(folder, "drone2", Identity(ids=(2, 2)), unasked)
    assert check_fleet(folder).member("drone2").certificate.serial == 7


def test_key_of_another_authority_is_refused(folder: Path, tmp_path: Path) -> None:
    """It would sign what no member accepts."""
    create(tmp_path / "other", relays=(Address("198.51.100.9", 5790),))
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
    operations.add(folder, "other", RELAY, unasked)
    operations.add(folder, "drone1", Identity(), unasked, replaces=True)
    operations.revoke(folder, "relay", unasked, resign=True)
    after = tomllib.loads(path.read_text())
    assert after["fleet"].pop("deny") == ["drone9", "drone8"]
    assert [contact["addresses"] for contact in after.pop("contact")] == [["198.51.100.9:5790"]]
    changed = {"authority", "successor", "certificate", "bulletin", "call"}
    assert set(after.pop("fleet")) <= changed
    assert after == {key: value for key, value in before.items() if key not in ("fleet", "contact")}
    assert "#" not in path.read_text().partition("\n\n")[2]
    check_fleet(folder)


def test_addresses_that_a_person_added_to_a_contact_are_kept(folder: Path) -> None:
    """A URL, and an address on one network, which replaces the signed one; also with a new key of the contact.

    URLs that the authority signed replace it.
    """
    path = folder / "drone1" / "drone1.toml"
    url, place = "wss://relay.example.org:443/uavlink", {"address": "relay.example.org:5790", "network": "lte"}
    own = f'addresses = [{{ address = "relay.example.org:5790", network = "lte" }}, "{url}"]'
    network = '\n[[network]]\nname = "lte"\ninterface = "wwan0"\n'
    path.write_text(path.read_text().replace('addresses = ["relay.example.org:5790"]', own) + network)
    operations.add(folder, "other", RELAY, unasked)
    operations.add(folder, "relay", Identity(), unasked, replaces=True)
    operations.add(folder, "drone1", Identity(), unasked, replaces=True)
    operations.revoke(folder, "other", unasked, resign=True)
    assert tomllib.loads(path.read_text())["contact"][0]["addresses"] == [place, url]
    assert [str(one) for one in check_fleet(folder).member("relay").addresses] == ["relay.example.org:5790"]
    signed = Identity(None, None, (Address("relay.example.org", 5790), Address("relay.example.org", 8443, "/other")))
    operations.add(folder, "relay", signed, unasked, replaces=True)
    contact = tomllib.loads(path.read_text())["contact"][0]
    assert contact["addresses"] == ["wss://relay.example.org:8443/other", place]
    path.write_text(path.read_text().replace(contact["certificate"], "AQAB"))
    operations.add(folder, "relay", Identity(), unasked, replaces=True)
    addresses = tomllib.loads(path.read_text())["contact"][0]["addresses"]
    assert addresses == ["relay.example.org:5790", "wss://relay.example.org:8443/other"]


def test_url_of_a_relay_reaches_the_members(tmp_path: Path) -> None:
    """As `init --relay` names it behind the relay's address. Another relay does not get it: it would not use it."""
    folder, url = tmp_path / "fleet", "wss://relay.example.org:443/uavlink"
    relays = parse_addresses("--relay", ["relay.example.org:5790", "wss://relay.example.org", "198.51.100.9:5790"])
    create(folder, drones=1, relays=relays)
    fleet = read_manifest(folder)
    assert [len(member.addresses) for member in fleet.members] == [2, 1, 0]
    for name, addresses in (("drone1", ["relay.example.org:5790", url]), ("relay2", ["relay.example.org:5790"])):
        assert tomllib.loads((folder / name / f"{name}.toml").read_text())["contact"][0]["addresses"] == addresses
    assert list(map(str, loaded(folder, "relay1").listen)) == ["0.0.0.0:5790", "[::]:5790"]
    (relay, _) = loaded(folder, "drone1").relays
    assert [str(address) for address in relay.addresses] == ["relay.example.org:5790", url]


@pytest.mark.parametrize("text", ["[fleet", "fleet = 1"])
def test_file_that_is_no_configuration_is_not_changed(folder: Path, text: str) -> None:
    """The command names its member among those that need a line, and it refuses to write the file."""
    path = folder / "drone3" / "drone3.toml"
    path.write_text(text)
    assert operations.add(folder, "other", RELAY, unasked).elsewhere == ("drone3",)
    assert path.read_text() == text
    before = snapshot(folder)
    with pytest.raises((FleetError, ConfigError)):
        operations.add(folder, "drone3", Identity(), unasked, replaces=True)
    assert snapshot(folder) == before


def test_any_table_is_written_as_it_was_read() -> None:
    """Keys that need quotes, control characters, empty lists, and tables in tables."""
    table = {
        "name": 'a "b"\\\n\x1f é',
        "none": [],
        "link": {"a key": {"b.c": [1, 2.5, True, {"d": "\t"}]}},
        "empty": {},
        "peer": [{"name": "one"}, {}],
    }
    assert tomllib.loads(toml_text(table)) == table


def test_two_commands_create_one_fleet(tmp_path: Path) -> None:
    """The second waits for the first, and neither deletes what the other one writes."""
    started = threading.Barrier(2)
    refusals: list[str] = []

    def init() -> None:
        started.wait(PATIENCE_S)
        try:
            create(tmp_path / "fleet", drones=2, relays=(Address("198.51.100.7", 5790),))
        except FleetError as error:
            refusals.append(str(error))

    threads = [threading.Thread(target=init) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refusals) == 1
    assert "exists already" in refusals[0]
    check_fleet(tmp_path / "fleet")
    assert [path.name for path in tmp_path.iterdir()] == ["fleet"]


ACTIONS: dict[str, Callable[[Path], object]] = {
    "add": lambda folder: operations.add(folder, "scout", RELAY, unasked),
    "revoke": lambda folder: operations.revoke(folder, "drone1", unasked, resign=True),
    "rotate": lambda folder: operations.add(folder, "drone1", Identity(), unasked, replaces=True),
}


@pytest.mark.parametrize("has_links", [True, False])
@pytest.mark.parametrize("step", ["write", "keep"])
@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_failed_write_changes_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, action: Callable[[Path], object], step: str, has_links: bool
) -> None:
    """If the last file cannot be written, the files before it are restored."""
    genuine = getattr(transaction.FileChanges, step)
    is_full = False

    def fail_at_the_manifest(self: Any, path: Path, *what: Any) -> Any:
        nonlocal is_full
        is_full = is_full or path.name == "fleet.toml"
        if is_full:  # the disk stays full: restoring files needs no space
            raise OSError(28, "No space left on device", str(path))
        return genuine(self, path, *what)

    monkeypatch.setattr(transaction.FileChanges, step, fail_at_the_manifest)
    if not has_links:
        monkeypatch.setattr(Path, "hardlink_to", refuse_link)
    with refused(folder, "No space left"):
        action(folder)
    assert not (folder / "scout").exists()


def refuse_link(*_: object) -> None:
    """As such a file system does."""
    raise PermissionError(1, "Operation not permitted")


def test_interrupted_command_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files are restored after Ctrl-C."""
    before = snapshot(folder)

    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(keys, "sync_folder", interrupt)  # the longest wait of the command
    with pytest.raises(KeyboardInterrupt):
        operations.add(folder, "drone1", Identity(), unasked, replaces=True)
    assert snapshot(folder) == before


def test_rotation_works_without_the_old_key(folder: Path, tmp_path: Path) -> None:
    """It is on the vehicle only. The new files replace those there."""
    (folder / "drone1").rename(tmp_path / "drone1")
    result = operations.add(folder, "drone1", Identity(), unasked, replaces=True)
    assert result.changed == ("drone1",)
    check_fleet(folder)


def test_rotated_key_is_removed_everywhere(folder: Path) -> None:
    """Its certificate is revoked by the same bulletin; name and ids stay."""
    old = read_manifest(folder).member("drone1")
    secret = (folder / "drone1" / "drone1.key").read_bytes()
    operations.add(folder, "drone1", Identity(), unasked, replaces=True)
    fleet = check_fleet(folder)
    new = fleet.member("drone1")
    assert (new.certificate.system_ids, new.certificate.serial) == (old.certificate.system_ids, 7)
    assert fleet.bulletin.revoked == (old.certificate.serial,)
    for path, content in snapshot(folder).items():
        assert content != secret
        assert path == "fleet.toml" or to_base64(old.public_key).encode() not in content


@pytest.mark.long
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_second_command_waits_for_the_first(tmp_path: Path, is_interrupted: bool) -> None:
    """It reads the files only when it has the lock, so it keeps the first's change. Ctrl-C ends the wait."""
    fleet, changed = tmp_path / "fleet", tmp_path / "changed"
    create(fleet, drones=1, relays=(Address("198.51.100.7", 5790),))
    shutil.copytree(fleet, changed)
    operations.add(changed, "other", Identity(), unasked)
    with ExitStack() as stack:
        held = stack.enter_context(ExitStack())
        held.enter_context(lock(fleet))
        second = stack.enter_context(
            subprocess.Popen(COMMAND, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        )
        stack.callback(second.kill)
        assert second.stderr is not None
        assert second.stderr.readline() == "waiting for another fleet command in fleet\n"
        shutil.copytree(changed, fleet, dirs_exist_ok=True)
        if is_interrupted:
            second.send_signal(signal.SIGINT)
        else:
            held.close()
        assert second.wait(PATIENCE_S) == is_interrupted
    members = read_manifest(fleet).members
    assert [member.name for member in members] == ["relay", "drone1", "other", *["scout"] * (not is_interrupted)]
    assert len({member.certificate.serial for member in members}) == len(members)
    for name in ("relay", "drone1", "other", *["scout"] * (not is_interrupted)):
        loaded(fleet, name)
