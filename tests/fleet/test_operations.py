"""Fleets on disk: what the commands write, and what a failure leaves."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from uavlinkd.config import keys
from uavlinkd.system.addresses import parse_address
from uavlinkd.config import Config, load_config
from uavlinkd.fleet import operations as work
from uavlinkd.fleet.manifest import Fleet, Kind, Settings, read_manifest
from uavlinkd.fleet.plan import FleetError


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def loaded(folder: Path, name: str) -> Config:
    """A member's configuration as its daemon reads it."""
    return load_config(folder / name / f"{name}.toml", {})


def check_fleet(folder: Path) -> Fleet:
    """Load every member, and see that each pair agrees on who is who; the fleet."""
    fleet = read_manifest(folder)
    configs = {member.name: loaded(folder, member.name) for member in fleet.members}
    for member in fleet.members:
        config = configs[member.name]
        assert keys.encode_key(config.public_key) == member.public_key
        peers = {peer.name: peer for peer in config.peers}
        assert set(peers) == {peer.name for peer in fleet.peers_of(member)}
        for name, peer in peers.items():
            assert peer.settings.public_key == configs[name].public_key
            back = next(each for each in configs[name].peers if each.name == member.name)
            assert peer.settings.psk == back.settings.psk
            assert (peer.settings.psk is not None) == fleet.settings.psk
    return fleet


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fleet of three drones, a ground station and an observer, with PSKs."""
    folder = tmp_path / "fleet"
    work.init(folder, Settings(psk=True), drones=3, ground_stations=1, observers=1)
    return folder


def test_new_fleet_is_one_that_every_daemon_takes(folder: Path) -> None:
    """Each configuration loads without a warning, and both ends of each pair agree on keys."""
    fleet = check_fleet(folder)
    names = ["drone1", "drone2", "drone3", "ground-station", "observer"]
    assert [member.name for member in fleet.members] == names
    assert [member.system_id for member in fleet.members] == [1, 2, 3, 255, 254]
    assert all(loaded(folder, name).warnings == () for name in names)


def test_roles_are_those_of_the_pair(folder: Path) -> None:
    """Drones fly along with each other, obey ground stations, are watched by observers; nobody else is linked."""
    roles = {
        (config.name, peer.name): (peer.policy["role"], peer.policy["system_ids"])
        for config in (loaded(folder, name) for name in ("drone1", "ground-station", "observer"))
        for peer in config.peers
    }
    assert roles == {
        ("drone1", "drone2"): ("swarm-member", (2,)),
        ("drone1", "drone3"): ("swarm-member", (3,)),
        ("drone1", "ground-station"): ("operator", (255,)),
        ("drone1", "observer"): ("observer", (254,)),
        **{("ground-station", f"drone{n}"): ("vehicle", (n,)) for n in (1, 2, 3)},
        **{("observer", f"drone{n}"): ("vehicle", (n,)) for n in (1, 2, 3)},
    }


def test_private_keys_are_in_their_own_folder_alone(folder: Path) -> None:
    """No private key stands anywhere but in one file of mode 0600; a PSK in the folders of its pair alone."""
    files = snapshot(folder)
    for name in ("drone1", "drone2", "drone3", "ground-station", "observer"):
        key = (folder / name / f"{name}.key").read_bytes().strip()
        assert [path for path, content in files.items() if key in content] == [f"{name}/{name}.key"]
    psk = (folder / "drone1" / "drone2.psk").read_bytes().strip()
    assert sorted(path for path, content in files.items() if psk in content) == [
        "drone1/drone2.psk",
        "drone2/drone1.psk",
    ]
    for path in folder.rglob("*"):
        if path.suffix in (".key", ".psk"):
            assert path.stat().st_mode & 0o777 == 0o600, path
    psks = [content for path, content in files.items() if path.endswith(".psk")]
    assert len(set(psks)) == len(psks) / 2


@pytest.mark.parametrize("damage", [b"\xff", b"[fleet", b"a = " + b"[" * 5000])
def test_damaged_manifest_is_refused_with_its_place(tmp_path: Path, damage: bytes) -> None:
    """Whatever is in the file: no traceback, and the file is named. Brackets can be too deep for the reader."""
    (tmp_path / "fleet.toml").write_bytes(damage)
    with pytest.raises(FleetError, match=r"fleet\.toml cannot be read: it is no TOML"):
        read_manifest(tmp_path)


def test_manifest_tells_public_facts_only(folder: Path) -> None:
    """Nothing secret stands in fleet.toml."""
    text = (folder / "fleet.toml").read_text()
    for path in folder.rglob("*"):
        if path.suffix in (".key", ".psk"):
            assert path.read_text().strip() not in text


def test_fleet_is_made_whole_or_not_at_all(tmp_path: Path) -> None:
    """A plan that gives bad configurations leaves nothing behind, and a fleet that is there is left alone."""
    with pytest.raises(FleetError, match="no good configuration"):
        work.init(tmp_path / "a" / "b", Settings(drone_url="udpin:127.0.0.1:5790"), 2, 0, 0)
    assert list((tmp_path / "a").iterdir()) == []
    work.init(tmp_path / "fleet", Settings(), 2, 0, 0)
    before = snapshot(tmp_path)
    with pytest.raises(FleetError, match="is there already"):
        work.init(tmp_path / "fleet", Settings(), 2, 0, 0)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    ("settings", "amounts", "reason"),
    [
        (Settings(), (0, 0, 0), "at least one"),
        (Settings(), (-1, 3, 0), "at least one"),
        (Settings(), (200, 56, 0), "at most 255"),
        (Settings(address_plan="10.13.0.0/29"), (7, 0, 0), "no address for drone7"),
        (Settings(address_plan="10.13.0.1/24"), (1, 0, 0), "neither a network"),
        (Settings(address_plan="10.13.0.{m}:5790"), (1, 0, 0), "gives no address"),
        (Settings(address_plan="{{}}"), (1, 0, 0), "gives no address"),
        (Settings(suite="rot13"), (1, 0, 0), "no suite"),
        (Settings(control_socket="{x}"), (1, 0, 0), "--control-socket.*only braces"),
    ],
)
def test_impossible_fleets_are_refused(
    tmp_path: Path, settings: Settings, amounts: tuple[int, int, int], reason: str
) -> None:
    """What cannot be is refused with its reason, and nothing is written."""
    with pytest.raises(FleetError, match=reason):
        work.init(tmp_path / "fleet", settings, *amounts)
    assert list(tmp_path.iterdir()) == []


def test_added_member_is_known_to_the_others(folder: Path) -> None:
    """A new drone is everybody's peer and they are its, with a PSK for each pair; the others' keys stay."""
    before = snapshot(folder)
    result = work.add(folder, "scout", Kind.DRONE)
    fleet = check_fleet(folder)
    assert set(result.changed) == {each.name for each in fleet.members}
    assert fleet.member("scout").system_id == 4
    assert str(fleet.member("scout").address) == "10.13.0.4:5790"
    after = snapshot(folder)
    assert all(after[path] == content for path, content in before.items() if not path.endswith(".toml"))


def test_second_ground_station_counts_down(folder: Path) -> None:
    """Ground stations have ids and addresses from the top, and no link with each other or observers."""
    work.add(folder, "truck", Kind.GROUND_STATION)
    member = check_fleet(folder).member("truck")
    assert (member.system_id, str(member.address)) == (253, "10.13.0.252:5790")
    assert {peer.name for peer in loaded(folder, "truck").peers} == {"drone1", "drone2", "drone3"}


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("drone2", {}, "already"),
        ("../drone9", {}, "is no name"),
        ("drone9", {"system_id": 3}, "system id of drone3"),
        ("drone9", {"system_id": 254}, "address of ground-station"),
        ("drone9", {"system_id": 256}, "from 1 to 255"),
    ],
)
def test_impossible_members_are_refused(folder: Path, name: str, options: dict[str, int], reason: str) -> None:
    """A member that cannot be is refused, and nothing changes."""
    before = snapshot(folder)
    with pytest.raises(FleetError, match=reason):
        work.add(folder, name, Kind.DRONE, system_id=options.get("system_id"))
    assert snapshot(folder) == before


def test_removed_member_is_forgotten_by_the_others(folder: Path) -> None:
    """Nobody has its key or a PSK with it any more; its own folder is left to its owner."""
    result = work.remove(folder, "drone2")
    assert set(result.changed) == {"drone1", "drone3", "ground-station", "observer"}
    check_fleet(folder)
    key = keys.public_key_text((folder / "drone2" / "drone2.key").read_text())
    left = {path: content for path, content in snapshot(folder).items() if not path.startswith("drone2/")}
    assert not [path for path, content in left.items() if key.encode() in content]
    assert not [path for path in left if path.endswith("drone2.psk")]


def test_no_member_keeps_a_removed_one_by_another_name(folder: Path) -> None:
    """A person renamed it in a file, or linked two that no role links: it is said where, and nothing is changed."""
    path = folder / "drone2" / "drone2.toml"
    path.write_text(path.read_text().replace('name = "drone1"', 'name = "scout"'))
    before = snapshot(folder)
    with pytest.raises(FleetError, match=r"drone2\.toml: peer\[0\] \(scout\) has a key of drone1"):
        work.remove(folder, "drone1")
    with pytest.raises(FleetError, match=r"drone2\.toml: it has no \[\[peer\]\] with the name .drone1."):
        work.rotate(folder, "drone1", at_once=True)
    assert snapshot(folder) == before
    text = path.read_text().replace('name = "scout"', 'name = "drone1"')
    key = read_manifest(folder).member("drone1").public_key
    path.write_text(f'{text}\n[[peer]]\nname = "second"\npublic_key = " {key}"\nrole = "all"\nsystem_ids = [9]\n')
    with pytest.raises(FleetError, match=r"peer\[4\] \(second\) has a key of drone1"):
        work.rotate(folder, "drone1", at_once=True)
    path.write_text(text)
    work.remove(folder, "drone1")
    check_fleet(folder)


def test_a_rotation_that_was_cut_short_can_be_made_again(folder: Path) -> None:
    """The power went when the keys were on the disk and nothing else: the old one stays the one before."""
    own = folder / "drone1"
    old = (own / "drone1.key").read_text()
    (own / "drone1.key").rename(own / "drone1.previous.key")
    keys.write_secret_file(own / "drone1.key", keys.generate_private_key())
    work.rotate(folder, "drone1")
    assert (own / "drone1.previous.key").read_text() == old
    fleet = check_fleet(folder)
    assert fleet.member("drone1").previous_public_key == keys.public_key_text(old)
    assert loaded(folder, "drone2").peers[0].previous_public_key == keys.decode_key(keys.public_key_text(old))


def test_edits_of_a_person_are_kept(folder: Path) -> None:
    """What was changed or remarked by hand in the others' files is there after members came and went."""
    path = folder / "drone1" / "drone1.toml"
    text = path.read_text().replace(
        'role = "operator"\n',
        'role = "operator"  # our captain\ndeny_in = ["files",\n  "MAV_CMD_DO_FLIGHTTERMINATION"]\n',
    )
    path.write_text(text + "\n[log]\nlevel = 'warning'  # quiet\n")
    work.add(folder, "scout", Kind.DRONE)
    work.remove(folder, "drone3")
    work.rotate(folder, "drone2", at_once=True)
    after = path.read_text()
    assert "# our captain" in after
    assert "level = 'warning'  # quiet" in after
    table = tomllib.loads(after)
    assert [peer["name"] for peer in table["peer"]] == ["drone2", "ground-station", "observer", "scout"]
    assert table["peer"][1]["deny_in"] == ["files", "MAV_CMD_DO_FLIGHTTERMINATION"]
    assert table["log"] == {"level": "warning"}
    check_fleet(folder)


def test_files_that_cannot_be_edited_safely_are_refused(folder: Path) -> None:
    """Where an edit by lines would not be the edit that is meant, nothing is changed at all."""
    path = folder / "drone3" / "drone3.toml"
    path.write_text(path.read_text() + 'description = """\n[[peer]]\nname = "drone1"\n[x]\n"""\n')
    before = snapshot(folder)
    with pytest.raises(FleetError, match="cannot be kept"):
        work.remove(folder, "drone1")
    assert snapshot(folder) == before


def test_folders_that_went_to_their_vehicles_are_not_needed(folder: Path, tmp_path: Path) -> None:
    """A configuration that is not here is written anew, whole, for the folder where it went."""
    (folder / "drone1").rename(tmp_path / "drone1")
    work.add(folder, "scout", Kind.DRONE)
    (folder / "drone1" / "drone1.toml").replace(tmp_path / "drone1" / "drone1.toml")
    (folder / "drone1" / "scout.psk").replace(tmp_path / "drone1" / "scout.psk")
    (folder / "drone1").rmdir()
    (tmp_path / "drone1").rename(folder / "drone1")
    check_fleet(folder)


ACTIONS: dict[str, Callable[[Path], object]] = {
    "add": lambda folder: work.add(folder, "scout", Kind.DRONE),
    "remove": lambda folder: work.remove(folder, "drone1"),
    "rotate": lambda folder: work.rotate(folder, "drone1"),
    "rotate at once": lambda folder: work.rotate(folder, "drone1", at_once=True),
}


@pytest.mark.parametrize("step", ["prepare", "replace"])
@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_failed_write_leaves_everything_as_it_was(
    folder: Path, monkeypatch: pytest.MonkeyPatch, action: Callable[[Path], object], step: str
) -> None:
    """Where the last file cannot be written, those before it are as they were."""
    before = snapshot(folder)
    genuine = getattr(work._Undo, step)
    is_full = False

    def fail_at_the_manifest(self: Any, path: Path, what: Any) -> Any:
        nonlocal is_full
        is_full = is_full or path.name == "fleet.toml"
        if is_full:  # and so it stays: having things as they were takes no room
            raise OSError(28, "No space left on device", str(path))
        return genuine(self, path, what)

    monkeypatch.setattr(work._Undo, step, fail_at_the_manifest)
    with pytest.raises(FleetError, match="No space left"):
        action(folder)
    assert snapshot(folder) == before
    assert not (folder / "scout").exists()


def test_interrupted_command_leaves_everything_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C is no half either."""
    before = snapshot(folder)

    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(keys, "_sync_folder", interrupt)  # as it may come in the longest of the waits
    with pytest.raises(KeyboardInterrupt):
        work.rotate(folder, "drone1", at_once=True)
    assert snapshot(folder) == before


def test_rotation_of_a_member_that_is_away_says_what_to_do_there(folder: Path, tmp_path: Path) -> None:
    """Its old key is on the vehicle alone: done as it says, nothing is lost, and both keys are good."""
    (folder / "drone1").rename(tmp_path / "drone1")
    result = work.rotate(folder, "drone1")
    assert any("mv drone1.key drone1.previous.key" in note for note in result.notes)
    assert any("drone1.toml was not here" in note for note in result.notes)
    (tmp_path / "drone1" / "drone1.key").rename(tmp_path / "drone1" / "drone1.previous.key")
    for path in (folder / "drone1").iterdir():
        path.replace(tmp_path / "drone1" / path.name)
    (folder / "drone1").rmdir()
    (tmp_path / "drone1").rename(folder / "drone1")
    check_fleet(folder)
    assert loaded(folder, "drone1").previous_private_key is not None


def test_a_member_whose_files_are_away_in_part_hinders_no_other(folder: Path, tmp_path: Path) -> None:
    """Its new key is here, the one before and the PSKs are on the vehicle: another may be added all the same."""
    (folder / "drone1").rename(tmp_path / "drone1")
    work.rotate(folder, "drone1")
    work.add(folder, "scout", Kind.DRONE)
    assert loaded(folder, "scout").peers


@pytest.mark.parametrize("address", ["0.0.0.0:5790", "10.13.0.200:14550"])
def test_member_that_no_daemon_would_take_is_not_added(folder: Path, address: str) -> None:
    """What `uavlinkd check` refuses, anywhere in the fleet, is refused here, and nothing is changed."""
    before = snapshot(folder)
    with pytest.raises(FleetError, match="no good configuration"):
        work.add(folder, "scout", Kind.DRONE, address=parse_address(address, allow_names=False))
    assert snapshot(folder) == before
    with pytest.raises(FleetError, match="1 to 255"):
        work.add(folder, "scout", Kind.DRONE, system_id=0)


def test_key_changed_at_once_leaves_nothing_of_the_old(folder: Path) -> None:
    """A key in wrong hands is replaced everywhere, and so is each PSK that lay beside it."""
    old = {path: content for path, content in snapshot(folder).items() if path.startswith("drone1/")}
    work.rotate(folder, "drone1", at_once=True)
    fleet = check_fleet(folder)
    assert fleet.member("drone1").previous_public_key is None
    secrets = [content for path, content in old.items() if not path.endswith(".toml")]
    public = keys.public_key_text(old["drone1/drone1.key"].decode())
    for content in snapshot(folder).values():
        assert public.encode() not in content
        assert content not in secrets


def test_all_system_ids_can_be_given(tmp_path: Path) -> None:
    """A fleet of 255 has every id and as many different addresses."""
    fleet = Fleet(Settings(address_plan="{name}.example.org:5790"))
    key = keys.public_key_text(keys.generate_private_key())
    for number in range(1, 256):
        kind = Kind.GROUND_STATION if number % 5 == 0 else Kind.DRONE
        fleet = fleet.with_member(fleet.new_member(f"m{number}", kind, key))
    assert {member.system_id for member in fleet.members} == set(range(1, 256))
    assert len({member.address for member in fleet.members}) == 255
    for a, b in combinations(fleet.members, 2):
        assert a.system_id < b.system_id or not (a.is_drone and b.is_drone)
    with pytest.raises(FleetError):
        fleet.new_member("one-more", Kind.DRONE, key)
