"""Enrolments by the commands, as an operator pipes them: what is written, and what is refused."""

from __future__ import annotations

import io
import json
import tomllib
from pathlib import Path

import pytest

from tests.fleet.conftest import Say
from tests.fleet.folders import create
from tests.ops.schema import golden
from uavlinkd.authority.enrolment import fingerprint_of
from uavlinkd.cli import main
from uavlinkd.config.load import load_config
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.ops import FLEET_LIST_SCHEMA
from uavlinkd.system.addresses import Address


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a fleet that has a relay."""
    monkeypatch.chdir(tmp_path)
    create(tmp_path / "fleet", relays=(Address("relay.example.org", 5790),))
    return tmp_path


def enrolled(say: Say, name: str, how: str = "", finish: str = "") -> str:
    return say(f"enroll --finish {finish}", say(f"fleet sign {how}", say(f"enroll {name}")))


def test_one_line_goes_each_way(place: Path, say: Say) -> None:
    """The result is a working file; the private key did not move, and both ends can compare the authority."""
    request = say("enroll v7")
    assert request == say("enroll v7")
    assert request.count("\n") == 1
    line = say("fleet sign --id 7", request)
    assert line.count("\n") == 1
    done = say("enroll --finish --url udpin:127.0.0.1:14551", line)
    fleet = read_manifest(place / "fleet")
    assert f"v7 is a member of fleet {fingerprint_of(fleet.authority.public)}." in done
    assert "of the autopilot to system id 7.\nThen: uavlinkd run --config v7.toml;" in done
    config = load_config(place / "v7.toml", {})
    assert config.fleet is not None
    assert config.fleet.own.certificate == fleet.member("v7").certificate
    assert [(contact.name, str(contact.addresses[0])) for contact in config.fleet.contacts] == [
        ("relay", "relay.example.org:5790")
    ]
    assert config.warnings == ()
    assert (place / "v7.key").stat().st_mode & 0o777 == 0o600
    private = (place / "v7.key").read_text().strip()
    assert all(private not in text for text in (request, line, done, (place / "v7.toml").read_text()))
    assert say("enroll --finish", line) == done


def test_address_in_the_line_is_listened_on(place: Path, say: Say) -> None:
    """A ground station with an address needs nothing more; `listen` in its file stays as it is."""
    done = enrolled(say, "station", "--role operator --address 198.51.100.7:6000")
    assert "Set the id of the ground control station to system id 255." in done
    assert "Then: uavlinkd relay --config vps.toml;" in enrolled(say, "vps", "--role relay --address 192.0.2.9:5790")
    assert list(map(str, load_config(place / "station.toml", {}).listen)) == ["0.0.0.0:6000"]
    (place / "other.toml").write_text('name = "other"\nprivate_key_file = "other.key"\nlisten = ["127.0.0.1:6000"]\n')
    enrolled(say, "other", "--role operator --address 198.51.100.8:6000")
    assert list(map(str, load_config(place / "other.toml", {}).listen)) == ["127.0.0.1:6000"]


def test_existing_configuration_keeps_its_values(place: Path, say: Say) -> None:
    """It becomes a member's with its own key; its pinned peers stay."""
    text = """\
name = "v7"
private_key_file = "keys/mine.key"  # since 2024
[link]
suites = ["x25519"]

[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"
"""
    (place / "keys").mkdir()
    (place / "v7.toml").write_text(text)
    enrolled(say, "v7")
    after = tomllib.loads((place / "v7.toml").read_text())
    before = tomllib.loads(text)
    assert after["link"].pop("confidential") is True
    assert {key: after[key] for key in before} == before
    assert (place / "keys/mine.key").exists()
    assert load_config(place / "v7.toml", {}).fleet is not None


def test_new_key_replaces_the_former_one_at_the_end(place: Path, say: Say) -> None:
    """Until then the daemon could restart with the former one. A line of the former key is refused afterwards."""
    request = say("enroll v7")
    first = say("fleet sign", request)
    say("enroll --finish", first)
    before = (place / "v7.toml").read_bytes()
    for _ in range(2):
        new = say("enroll v7")
        assert new == say("enroll v7") != request
        assert (place / "v7.toml").read_bytes() == before
        assert 'refused: this fleet has a "v7" already' in say("fleet sign", new)
        assert say("fleet sign --replace gs", new) == "refused: the line is of v7, not of gs: nothing was signed\n"
        line = say("fleet sign --replace v7", new)
        assert "The former key, " in say("enroll --finish", line)
        assert len(list(place.glob("v7*.key"))) == 1
        before = (place / "v7.toml").read_bytes()
        assert say("enroll --finish", first).startswith("refused: the line was used or is old")
        assert (place / "v7.toml").read_bytes() == before
        request = new
    assert read_manifest(place / "fleet").bulletin.revoked == (2, 3)


def test_what_is_to_be_done_is_on_standard_error(
    place: Path, say: Say, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a new key; and a command that waits for a line on a terminal says for which one."""
    enrolled(say, "v7")
    monkeypatch.setattr("sys.stdin", Terminal(say("enroll v7")))
    assert main(["fleet", "sign", "--replace", "v7"]) == 0
    error = capsys.readouterr().err
    assert error.startswith("paste the line of `uavlinkd enroll NAME`, then press Enter\n")
    assert "serial 2 is revoked: `enroll --finish`, `uavlinkd fleet publish`, then restart it\n" in error
    monkeypatch.setattr("sys.stdin", Terminal(say("fleet sign v7")))
    assert main(["enroll", "--finish"]) == 0
    assert "compare the fleet's eight characters with those that `fleet sign` printed" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", Terminal("a"))
    assert main(["fleet", "restore"]) == 2
    assert capsys.readouterr().err.startswith("type both lines of the paper copy, then press Ctrl-D\n")


class Terminal(io.StringIO):
    """Standard input on which a person types."""

    def isatty(self) -> bool:
        return True


def test_former_key_that_cannot_be_deleted_is_an_error(
    place: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names the file. The configuration has the new key already; the same line once more deletes the old one."""
    enrolled(say, "v7")
    line = say("fleet sign --replace v7", say("enroll v7"))
    unlink = Path.unlink

    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path.name == "v7.key":
            raise PermissionError(1, "Operation not permitted", str(path))
        unlink(path, missing_ok)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        assert say("enroll --finish", line) == "refused: v7.key: Operation not permitted\n"
    assert load_config(place / "v7.toml", {}).public_key == read_manifest(place / "fleet").member("v7").public_key
    assert "The former key, v7.key, was deleted." in say("enroll --finish", line)
    assert [path.name for path in place.glob("v7*.key")] == ["v7.2.key"]
    assert not list(place.glob(".*"))


def test_lines_that_cannot_be_used_are_refused(
    place: Path, say: Say, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the reason; no file changes."""
    other = tmp_path_factory.mktemp("other")
    create(other / "fleet", relays=(Address("relay.example.org", 5790),))
    line = say("fleet sign", say("enroll v7"))
    foreign = say(f"fleet sign --out {other / 'fleet'}", say("enroll v7"))
    of_v8 = say("fleet sign", say("enroll v8"))
    say("enroll --finish --config v8.toml", of_v8)
    assert "the line is for v7, and v8.toml is of v8" in say("enroll --finish --config v8.toml", line)
    say("enroll --finish", line)
    before = {path: path.read_bytes() for path in place.glob("*.*")}
    assert "was cut or changed" in say("enroll --finish", line[:300])
    assert say("enroll --finish") == "refused: no line arrived: see the message of `uavlinkd fleet sign`\n"
    assert "has the certificate of another key, named v8" in say("enroll --finish --config v7.toml", of_v8)
    assert "the line is of fleet" in say("enroll --finish", foreign)
    assert "is the request" in say("enroll --finish", say("enroll v7"))
    assert "nor a range" in say("fleet sign --id 7-x", say("enroll v7"))
    (place / "v7.2.key").unlink()
    assert "copy it again" in say("fleet sign", "uavlink-enroll-1 v7")
    assert "`uavlinkd enroll NAME`" in say("enroll")
    assert "options of `uavlinkd enroll --finish`" in say("enroll v9 --url udpin:127.0.0.1:14999")
    for change in ("--id 8", "--role operator", "--address 192.0.2.1:5790", "--replace v7"):
        assert "to change it, sign the line of `uavlinkd enroll` with --replace v7" in say(f"fleet sign v7 {change}")
    assert "is not a name" in say("enroll V7")
    monkeypatch.chdir(other)
    assert "the line is for v7, and there is no v7.key: for another machine, card or folder, add --replace" in say(
        "enroll --finish", line
    )
    monkeypatch.chdir(place)
    assert {path: path.read_bytes() for path in place.glob("*.*")} == before


def test_file_that_a_daemon_would_refuse_is_not_changed(place: Path, say: Say) -> None:
    """The problems are those of `uavlinkd check`."""
    line = say("fleet sign", say("enroll v7"))
    for text, reason in (
        ('name = "v7"\ncolour = 1\n', "colour"),
        ("name =", "not valid TOML"),
        ("[fleet]\n", "damaged"),
    ):
        (place / "v7.toml").write_text(text)
        assert reason in say("enroll --finish", line)
        assert (place / "v7.toml").read_text() == text
    assert not list(place.glob(".*"))


def test_members_are_listed(place: Path, say: Say) -> None:
    """Former ones too."""
    enrolled(say, "v7", "--id 70-79")
    assert "have not heard of it" in say("fleet remove v7")
    rows = [line.split() for line in say("fleet list").splitlines()]
    assert rows[0][2:] == ["bulletin", "2"]
    assert [row[:4] for row in rows[2:]] == [["relay", "relay", "-", "1"], ["v7", "vehicle", "70-79", "2"]]
    assert rows[3][-1] == "revoked"
    facts = json.loads(say("fleet list --json"))
    revoked = {name: member["is_revoked"] for name, member in facts["members"].items()}
    assert (facts["number"], revoked) == (2, {"relay": False, "v7": True})
    names = golden.names_of(facts, maps=["members"])
    assert golden.differences("fleet-list", FLEET_LIST_SCHEMA, golden.load("fleet-list"), names) == []
    assert "v7 is revoked" in say("fleet sign v7")
    assert 'has no "v8"' in say("fleet sign v8")


def test_files_of_a_service(place: Path, say: Say) -> None:
    """Keys are in a folder of their own, which is made; the control socket is where the unit has it, or as said."""
    options = "--config etc/v7.toml --keys etc/v7"
    enrolled_line = say("fleet sign", say(f"enroll v7 {options}"))
    say(f"enroll --finish {options}", enrolled_line)
    table = tomllib.loads((place / "etc/v7.toml").read_text())
    assert table["control_socket"] == "/run/uavlinkd/v7/control.sock"
    assert ((place / "etc/v7").stat().st_mode & 0o777, [*(place / "etc/v7").iterdir()]) == (
        0o700,
        [place / "etc/v7/v7.key"],
    )
    enrolled(say, "v8", finish="--control-socket /run/v8.sock --url udpin:127.0.0.1:14999")
    table = tomllib.loads((place / "v8.toml").read_text())
    assert (table["control_socket"], table["endpoint"][0]["url"]) == ("/run/v8.sock", "udpin:127.0.0.1:14999")
