"""Fleets on disk: the files that the commands write, and those after a failure; two commands at once; templates."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.vehicles import loaded
from tests.waiting import PATIENCE_S
from uavlinkd.config import keys
from uavlinkd.fleet import operations, transaction
from uavlinkd.fleet.manifest import (
    Fleet,
    FleetError,
    FleetSettings,
    MemberKind,
    check_settings,
    fill,
    planned_address,
    read_manifest,
)
from uavlinkd.fleet.transaction import check_members, lock
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.system.addresses import parse_address

COMMAND = end_with_parent(sys.executable, "-m", "uavlinkd", "fleet", "add", "scout", "--out", "fleet")


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
    """Load every member, check that both ends of every pair agree, and return the fleet."""
    fleet = read_manifest(folder)
    configs = {member.name: loaded(folder, member.name) for member in fleet.members}
    for member in fleet.members:
        config = configs[member.name]
        assert keys.encode_key(config.public_key) == member.public_key
        peers = {peer.name: peer for peer in config.peers}
        assert set(peers) == {peer.name for peer in fleet.peers_of(member)}
        for name, peer in peers.items():
            assert peer.settings.public_key == configs[name].public_key
            back = next(other for other in configs[name].peers if other.name == member.name)
            assert peer.settings.psk == back.settings.psk
            assert (peer.settings.psk is not None) == fleet.settings.psk
    return fleet


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fleet of three drones, a ground station and an observer, with PSKs."""
    folder = tmp_path / "fleet"
    operations.init(folder, FleetSettings(psk=True), drones=3, ground_stations=1, observers=1)
    return folder


def test_every_daemon_accepts_a_new_fleet(folder: Path) -> None:
    """Each configuration loads without a warning, and both ends of each pair agree on keys."""
    fleet = check_fleet(folder)
    names = ["drone1", "drone2", "drone3", "ground-station", "observer"]
    assert [member.name for member in fleet.members] == names
    assert [member.system_id for member in fleet.members] == [1, 2, 3, 255, 254]
    assert all(loaded(folder, name).warnings == () for name in names)


def test_roles_are_those_of_the_pair(folder: Path) -> None:
    """Drones are linked with each other, ground stations and observers; other kinds are not linked."""
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
    """A private key is in one file, with mode 0600, and a PSK in the folders of its pair only."""
    files = snapshot(folder)
    for name in ("drone1", "drone2", "drone3", "ground-station", "observer"):
        key = (folder / name / f"{name}.key").read_bytes().strip()
        assert [path for path, content in files.items() if key in content] == [f"{name}/{name}.key"]
    for path in folder.rglob("*.psk"):
        places = {place for place, content in files.items() if path.read_bytes().strip() in content}
        one, other = path.parent.name, path.stem
        assert places == {f"{one}/{other}.psk", f"{other}/{one}.psk"}
    assert {path.stat().st_mode & 0o777 for path in folder.rglob("*.[kp][es][yk]")} == {0o600}


@pytest.mark.parametrize("damage", [b"\xff", b"[fleet", b"a = " + b"[" * 5000])
def test_damaged_manifest_is_refused(tmp_path: Path, damage: bytes) -> None:
    """The error names the file. Brackets can be nested too deeply for the parser."""
    (tmp_path / "fleet.toml").write_bytes(damage)
    with pytest.raises(FleetError, match=r"fleet\.toml is not valid TOML"):
        read_manifest(tmp_path)


def test_fleet_is_made_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It appears at once, whole, and not if a configuration is not valid. An existing fleet is not changed."""
    with pytest.raises(FleetError, match="not valid"):
        operations.init(tmp_path / "a" / "b", FleetSettings(drone_url="udpin:127.0.0.1:5790"), 2, 0, 0)
    assert list((tmp_path / "a").iterdir()) == []
    rename, appeared = Path.rename, []

    def watch(path: Path, target: Path) -> Path:
        if target == tmp_path / "fleet":
            appeared.append(sorted(file.name for file in path.iterdir()))
        assert bool(appeared) or not (tmp_path / "fleet").exists()
        return rename(path, target)

    with monkeypatch.context() as watched:
        watched.setattr(Path, "rename", watch)
        operations.init(tmp_path / "fleet", FleetSettings(), 2, 0, 0)
    assert appeared == [["drone1", "drone2", "fleet.toml"]]
    with refused(tmp_path, "exists already"):
        operations.init(tmp_path / "fleet", FleetSettings(), 2, 0, 0)


@pytest.mark.parametrize(
    ("settings", "counts", "reason"),
    [
        (FleetSettings(), (0, 0, 0), "at least one"),
        (FleetSettings(), (-1, 3, 0), "at least one"),
        (FleetSettings(), (200, 56, 0), "at most 255"),
        (FleetSettings(address_plan="10.13.0.0/29"), (7, 0, 0), "no address for drone7"),
        (FleetSettings(address_plan="10.13.0.1/24"), (1, 0, 0), "neither a network"),
        (FleetSettings(address_plan="10.13.0.{m}:5790"), (1, 0, 0), "has no address"),
        (FleetSettings(address_plan="{{}}"), (1, 0, 0), "has no address"),
        (FleetSettings(suite="rot13"), (1, 0, 0), "suite .* does not exist"),
        (FleetSettings(control_socket="{x}"), (1, 0, 0), "--control-socket.*only braces"),
    ],
)
def test_impossible_fleets_are_refused(
    tmp_path: Path, settings: FleetSettings, counts: tuple[int, int, int], reason: str
) -> None:
    """What cannot be is refused with its reason, and nothing is written."""
    with pytest.raises(FleetError, match=reason):
        operations.init(tmp_path / "fleet", settings, *counts)
    assert list(tmp_path.iterdir()) == []


def test_added_member_is_known_to_the_others(folder: Path) -> None:
    """A new drone and every other member are peers, with a PSK for each pair. The others' keys stay."""
    before = snapshot(folder)
    result = operations.add(folder, "scout", MemberKind.DRONE)
    fleet = check_fleet(folder)
    assert set(result.changed) == {member.name for member in fleet.members}
    assert fleet.member("scout").system_id == 4
    assert str(fleet.member("scout").address) == "10.13.0.4:5790"
    after = snapshot(folder)
    assert all(after[path] == content for path, content in before.items() if not path.endswith(".toml"))


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("drone2", {}, "already"),
        ("../drone9", {}, "is not a name"),
        ("drone9", {"system_id": 3}, "system id of drone3"),
        ("drone9", {"system_id": 254}, "address of ground-station"),
        ("drone9", {"system_id": 256}, "from 1 to 255"),
    ],
)
def test_impossible_members_are_refused(folder: Path, name: str, options: dict[str, int], reason: str) -> None:
    """The command changes nothing if the member is not possible."""
    with refused(folder, reason):
        operations.add(folder, name, MemberKind.DRONE, system_id=options.get("system_id"))


def test_removed_member_is_forgotten_by_the_others(folder: Path) -> None:
    """No other folder contains its key or a PSK with it. Its own folder is kept."""
    result = operations.remove(folder, "drone2")
    assert set(result.changed) == {"drone1", "drone3", "ground-station", "observer"}
    check_fleet(folder)
    key = keys.public_key_text((folder / "drone2" / "drone2.key").read_text())
    left = {path: content for path, content in snapshot(folder).items() if not path.startswith("drone2/")}
    assert not [path for path, content in left.items() if key.encode() in content]
    assert not [path for path in left if path.endswith("drone2.psk")]


def test_removed_key_is_found_under_another_name(folder: Path) -> None:
    """The user renamed a peer, or added one: the error names file and section, and the command changes nothing."""
    path = folder / "drone2" / "drone2.toml"
    path.write_text(path.read_text().replace('name = "drone1"', 'name = "scout"'))
    with refused(folder, r"drone2\.toml: peer\[0\] \(scout\) has the key of drone1"):
        operations.remove(folder, "drone1")
    with refused(folder, r"drone2\.toml: it has no \[\[peer\]\] with the name .drone1."):
        operations.rotate(folder, "drone1")
    text = path.read_text().replace('name = "scout"', 'name = "drone1"')
    key = read_manifest(folder).member("drone1").public_key
    path.write_text(f'{text}\n[[peer]]\nname = "second"\npublic_key = " {key}"\nrole = "all"\nsystem_ids = [9]\n')
    with pytest.raises(FleetError, match=r"peer\[4\] \(second\) has the key of drone1"):
        operations.rotate(folder, "drone1")
    path.write_text(text)
    operations.remove(folder, "drone1")
    check_fleet(folder)


def test_edits_of_the_user_are_kept(folder: Path) -> None:
    """Changed keys and comments in a file are kept when members are added, removed and rotated."""
    path = folder / "drone1" / "drone1.toml"
    text = path.read_text().replace(
        'role = "operator"\n',
        'role = "operator"  # our captain\ndeny_in = ["files",\n  "MAV_CMD_DO_FLIGHTTERMINATION"]\n',
    )
    path.write_text(text + "\n[log]\nlevel = 'warning'  # quiet\n")
    operations.add(folder, "scout", MemberKind.DRONE)
    operations.remove(folder, "drone3")
    operations.rotate(folder, "drone2")
    after = path.read_text()
    assert "# our captain" in after
    assert "level = 'warning'  # quiet" in after
    table = tomllib.loads(after)
    assert [peer["name"] for peer in table["peer"]] == ["drone2", "ground-station", "observer", "scout"]
    assert table["peer"][1]["deny_in"] == ["files", "MAV_CMD_DO_FLIGHTTERMINATION"]
    assert table["log"] == {"level": "warning"}
    check_fleet(folder)


def test_files_that_cannot_be_edited_safely_are_refused(folder: Path) -> None:
    """The command changes nothing if editing by lines would change something else."""
    path = folder / "drone3" / "drone3.toml"
    path.write_text(path.read_text() + 'description = """\n[[peer]]\nname = "drone1"\n[x]\n"""\n')
    with refused(folder, "cannot be kept"):
        operations.remove(folder, "drone1")


def test_folders_on_their_vehicles_are_not_needed(folder: Path, tmp_path: Path) -> None:
    """A missing configuration is written completely, so that it can replace the one on the vehicle."""
    (folder / "drone1").rename(tmp_path / "drone1")
    operations.add(folder, "scout", MemberKind.DRONE)
    (folder / "drone1" / "drone1.toml").replace(tmp_path / "drone1" / "drone1.toml")
    (folder / "drone1" / "scout.psk").replace(tmp_path / "drone1" / "scout.psk")
    (folder / "drone1").rmdir()
    (tmp_path / "drone1").rename(folder / "drone1")
    check_fleet(folder)


ACTIONS: dict[str, Callable[[Path], object]] = {
    "add": lambda folder: operations.add(folder, "scout", MemberKind.DRONE),
    "remove": lambda folder: operations.remove(folder, "drone1"),
    "rotate": lambda folder: operations.rotate(folder, "drone1"),
}


@pytest.mark.parametrize("has_links", [True, False])
@pytest.mark.parametrize("step", ["prepare", "replace"])
@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_failed_write_changes_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, action: Callable[[Path], object], step: str, has_links: bool
) -> None:
    """If the last file cannot be written, the files before it are restored."""
    genuine = getattr(transaction.Rollback, step)
    is_full = False

    def fail_at_the_manifest(self: Any, path: Path, what: Any) -> Any:
        nonlocal is_full
        is_full = is_full or path.name == "fleet.toml"
        if is_full:  # the disk stays full: restoring files needs no space
            raise OSError(28, "No space left on device", str(path))
        return genuine(self, path, what)

    monkeypatch.setattr(transaction.Rollback, step, fail_at_the_manifest)
    if not has_links:
        monkeypatch.setattr(Path, "hardlink_to", refuse_link)
    with refused(folder, "No space left"):
        action(folder)
    assert not (folder / "scout").exists()


@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_file_system_without_hard_links(
    folder: Path, monkeypatch: pytest.MonkeyPatch, action: Callable[[Path], object]
) -> None:
    """Each command works there, and leaves nothing beside its files."""
    monkeypatch.setattr(Path, "hardlink_to", refuse_link)
    action(folder)
    check_fleet(folder)
    assert not list(folder.rglob(".*"))


def refuse_link(*_: object) -> None:
    """As such a file system does."""
    raise PermissionError(1, "Operation not permitted")


def test_interrupted_command_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files are restored after Ctrl-C."""
    before = snapshot(folder)

    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(keys, "_sync_folder", interrupt)  # the longest wait of the command
    with pytest.raises(KeyboardInterrupt):
        operations.rotate(folder, "drone1")
    assert snapshot(folder) == before


def test_rotation_works_without_the_old_key(folder: Path, tmp_path: Path) -> None:
    """It is on the vehicle only. The new files replace those there."""
    (folder / "drone1").rename(tmp_path / "drone1")
    result = operations.rotate(folder, "drone1")
    assert any("drone1.toml was not here" in note for note in result.notes)
    check_fleet(folder)


def test_rotation_that_an_earlier_version_began_is_refused(folder: Path) -> None:
    """The message says what to delete."""
    path = folder / "fleet.toml"
    key = read_manifest(folder).member("drone1").public_key
    path.write_text(
        path.read_text().replace('name = "drone1"\n', f'name = "drone1"\nprevious_public_key = "{key}"\n')
    )
    with refused(folder, "the key of drone1 was being rotated, .* delete previous_public_key"):
        operations.remove(folder, "drone2")


@pytest.mark.parametrize("address", ["0.0.0.0:5790", "10.13.0.200:14550"])
def test_member_with_a_configuration_that_is_not_valid_is_not_added(folder: Path, address: str) -> None:
    """The command refuses configurations that `uavlinkd check` refuses, and changes nothing."""
    with refused(folder, "not valid"):
        operations.add(folder, "scout", MemberKind.DRONE, address=parse_address(address, allow_names=False))
    with refused(folder, "1 to 255"):
        operations.add(folder, "scout", MemberKind.DRONE, system_id=0)


def test_rotated_key_is_removed_everywhere(folder: Path) -> None:
    """A rotation replaces the key and the member's PSKs in all folders."""
    old = {path: content for path, content in snapshot(folder).items() if path.startswith("drone1/")}
    operations.rotate(folder, "drone1")
    check_fleet(folder)
    secrets = [content for path, content in old.items() if not path.endswith(".toml")]
    public = keys.public_key_text(old["drone1/drone1.key"].decode())
    for content in snapshot(folder).values():
        assert public.encode() not in content
        assert content not in secrets


@pytest.mark.parametrize(
    ("template", "text"),
    [("", ""), ("10.13.0.{n}:5790", "10.13.0.7:5790"), ("{name}.local:{n}{n}", "{n}.local:77"), ("%s {n}", "%s 7")],
)
def test_number_and_name_are_put_in(template: str, text: str) -> None:
    """``{n}`` and ``{name}`` are replaced. Other text is kept, and braces in a name too."""
    assert fill(template, 7, "{n}") == text


@pytest.mark.parametrize(
    "template",
    [
        *("{name.__class__}", "{name.__class__.__mro__}", "{n.real}", "{0}", "{}", "{name!r}", "{n:>9999999}"),
        *("{name[0]}", "{ n }", "{N}", "{{n}}", "{n", "n}"),
    ],
)
def test_anything_else_in_braces_is_refused(template: str) -> None:
    """Attributes, items, positions, conversions, widths and unpaired braces; the error names the option."""
    with pytest.raises(FleetError, match=r"\{n\} and \{name\}"):
        fill(template, 7, "scout")
    with pytest.raises(FleetError, match="address plan"):
        planned_address(f"{{name}}{template}:5790", "scout", 7, is_drone=True)
    for key in ("control_socket", "drone_url", "ground_station_url"):
        settings: dict[str, str] = {key: f"/run/{template}"}
        with pytest.raises(FleetError, match=f"--{key.replace('_', '-')}"):
            check_settings(replace(FleetSettings(), **settings))  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_second_command_waits_for_the_first(tmp_path: Path, is_interrupted: bool) -> None:
    """It reads the files only when it has the lock, so it keeps the first's change. Ctrl-C ends the wait."""
    fleet, changed = tmp_path / "fleet", tmp_path / "changed"
    operations.init(fleet, FleetSettings(), drones=2, ground_stations=0, observers=0)
    shutil.copytree(fleet, changed)
    operations.add(changed, "relay", MemberKind.DRONE)
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
    assert [member.name for member in members] == ["drone1", "drone2", "relay", *["scout"] * (not is_interrupted)]
    assert len({member.system_id for member in members}) == len(members)
    check_members(fleet, members)
