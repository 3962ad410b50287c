"""The command line: arguments in, exit status out."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import need
from uavlinkd import __version__
from uavlinkd.cli import main, mitm
from uavlinkd.config import keys
from uavlinkd.protocol.constants import PROTOCOL_NAME
from uavlinkd.system.terminal import FAILED, OK, WRONG

pytestmark = pytest.mark.usefixtures("undone_settings")


def test_keygen_writes_a_key_that_only_its_owner_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Mode 0600 whatever the umask; standard output has the public key and nothing else."""
    path = tmp_path / "drone0.key"
    assert main(["keygen", "--out", str(path)]) == OK
    assert path.stat().st_mode & 0o777 == 0o600
    private = path.read_text()
    out, err = capsys.readouterr()
    assert out == keys.public_key_text(private.strip()) + "\n"
    assert err == ""
    assert private.strip() not in out


@pytest.mark.parametrize("command", ["keygen", "psk"])
def test_a_key_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """An existing file stays as it is; one line reports it, status 1."""
    path = tmp_path / "some.key"
    path.write_text("precious")
    assert main([command, "--out", str(path)]) == FAILED
    assert path.read_text() == "precious"
    out, err = capsys.readouterr()
    assert out == ""
    assert str(path) in err
    assert err.count("\n") == 1


def test_pubkey_reads_a_file_or_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both print the public key that keygen printed. Without a file, keygen is a filter too."""
    path = tmp_path / "drone0.key"
    main(["keygen", "--out", str(path)])
    printed = capsys.readouterr().out
    assert main(["pubkey", str(path)]) == OK
    assert capsys.readouterr().out == printed
    monkeypatch.setattr(sys, "stdin", io.StringIO(path.read_text()))
    assert main(["pubkey"]) == OK
    assert capsys.readouterr().out == printed
    assert main(["pubkey", str(tmp_path / "absent.key")]) == FAILED
    assert "absent.key" in capsys.readouterr().err
    assert main(["keygen"]) == OK
    private, err = capsys.readouterr()
    assert keys.public_key_text(private) in err
    assert private.strip() not in err


@pytest.mark.parametrize("text", [b"", b"hunter2", b"A" * 43, b"A" * 45, b"-" * 44, b"\xff\xfe" + bytes(30)])
def test_pubkey_of_an_invalid_key_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, text: bytes
) -> None:
    """One line, which does not repeat the input: it may be almost a key."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text), encoding="utf-8"))
    assert main(["pubkey"]) == FAILED
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert not text or text.decode(errors="replace") not in err


def test_keys_are_those_of_wireguard(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """``wg pubkey`` prints the same public key; keys of ``wg genkey`` and ``wg genpsk`` are valid here."""
    wg = shutil.which("wg")
    need(wg is not None, "wg, of wireguard-tools")
    assert wg is not None
    main(["keygen"])
    private = capsys.readouterr().out
    theirs = subprocess.run([wg, "pubkey"], input=private, capture_output=True, text=True, check=True).stdout
    monkeypatch.setattr(sys, "stdin", io.StringIO(private))
    main(["pubkey"])
    assert capsys.readouterr().out == theirs
    for command in ("genkey", "genpsk"):
        made = subprocess.run([wg, command], capture_output=True, text=True, check=True).stdout
        assert len(keys.decode_key(made.strip())) == 32


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["run"],
        ["check"],
        ["run", "--config"],
        ["demo", "--seconds", "many"],
        ["sim", "--system-id", "x"],
        *(["demo", f"--seconds={seconds}"] for seconds in ("0", "-1", "nan", "inf")),
        *(["demo", "--attack", attack] for attack in ("nonsense", "bit-flip,size=3", "misroute")),
        ["sim", "--seconds", "nan"],
    ],
)
def test_a_wrong_command_line_gives_status_2(arguments: list[str]) -> None:
    """Status 2 for a missing, unknown or invalid argument."""
    try:
        status = main(arguments)
    except SystemExit as ended:
        status = int(str(ended.code))
    assert status == WRONG


@pytest.mark.parametrize(
    ("words", "wrong", "meant"),
    [
        ("stauts", "stauts", "status"),
        ("help stauts", "stauts", "status"),
        ("fleet lst", "lst", "list"),
        ("run --confg drone0.toml", "--confg", "--config"),
        ("check --config=drone0.toml --verbsoe --key .", "--verbsoe", "--verbose"),
        ("fleet list --jsn", "--jsn", "--json"),
        ("fleet sign --role vehicel", "vehicel", "vehicle"),
        ("--verson", "--verson", "--version"),
    ],
)
def test_a_misspelt_word_is_named(words: str, wrong: str, meant: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A command, an option or a choice, as in a file."""
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == WRONG
    assert f"there is no '{wrong}': did you mean '{meant}'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ([], "run the daemon"),
        (["fleet"], "revoke a member"),
        (["run", "x.toml"], "write `uavlinkd run --config x.toml`"),
        (["station", "remove", "tab2"], "write `uavlinkd station remove --config FILE tab2`"),
    ],
)
def test_an_incomplete_command_line_shows_what_to_write(
    words: list[str], shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands, or the option before a file."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == WRONG
    assert shown in capsys.readouterr().err


def test_an_unknown_argument_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """With the usage of the command itself."""
    with pytest.raises(SystemExit):
        main(["fleet", "list", "v7"])
    assert re.search("^usage: uavlinkd fleet list .*unknown argument 'v7'", capsys.readouterr().err, re.DOTALL)


def test_help_shows_commands_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    """Of all commands, or of one."""
    for words, option in (
        (["--help"], "--version"),
        (["help"], "--version"),
        (["fleet", "sign", "--help"], "--replace"),
        (["help", "fleet", "sign"], "--replace"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == OK
        assert option in capsys.readouterr().out


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """``--version`` prints it and that of the protocol, which must be equal at both ends, with status 0."""
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == OK
    assert capsys.readouterr().out == f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}\n"


@pytest.mark.parametrize("command", ["run", "check", "status", "reload"])
def test_an_absent_file_gives_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """One line with the file's name."""
    assert main([command, "--config", str(tmp_path / "absent.toml")]) == WRONG
    out, err = capsys.readouterr()
    assert out == ""
    assert "absent.toml" in err
    assert err.count("\n") == 1


_SERVICE = """
name = "drone0"
private_key_file = "drone0.key"
control_socket = "control.sock"

[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"

[[peer]]
name = "drone1"
public_key = "6rQAWoQk1TImT5HbhGECTbJyT0zUMPgOWIZDNPtyvkg="
addresses = ["10.13.0.2:5790"]
role = "all"
system_ids = [2]
"""


def test_check_reads_a_services_keys_from_their_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A service has its keys in a separate folder; without ``--keys`` the message shows the option."""
    (tmp_path / "keys").mkdir()
    assert main(["keygen", "--out", str(tmp_path / "keys" / "drone0.key")]) == OK
    path = tmp_path / "drone0.toml"
    path.write_text(_SERVICE)
    assert main(["check", "--config", str(path)]) == WRONG
    assert "--keys" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "absent")]) == WRONG
    assert "--keys" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "keys")]) == OK
    assert capsys.readouterr().out.startswith("warning: "), "before the facts"
    assert main(["check", "--config", str(path), "--json"]) == WRONG
    assert "drone0.key" in json.loads(capsys.readouterr().out)["errors"][0]
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "keys"), "--json"]) == OK
    facts = json.loads(capsys.readouterr().out)
    assert (facts["errors"], len(facts["warnings"])) == ([], 1)


def test_status_needs_only_the_control_socket_of_a_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``status`` works without the keys, and if other values in the file are wrong."""
    path = tmp_path / "drone0.toml"
    path.write_text(_SERVICE.replace("system_ids = [2]", "system_ids = [900]"))
    assert main(["status", "--config", str(path)]) == FAILED
    assert capsys.readouterr().err.startswith(f"no daemon answers at {tmp_path / 'control.sock'}")
    path.write_text(_SERVICE.replace('"control.sock"', "7"))
    assert main(["status", "--config", str(path)]) == WRONG
    (line,) = capsys.readouterr().err.splitlines()
    assert "control_socket" in line


@pytest.mark.parametrize("command", ["demo", "sim", "evaluate timing", "evaluate --help"])
@pytest.mark.parametrize("module", ["pymavlink", "uavlinkd.lab"])
def test_a_command_without_the_laboratory_names_the_extra(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, module: str, command: str
) -> None:
    """A plain installation has no pymavlink, and the Debian package no ``uavlinkd.lab``: one line says what to do."""
    monkeypatch.setitem(sys.modules, module, None)
    assert main(command.split()) == FAILED
    assert mitm([]) == FAILED
    out, err = capsys.readouterr()
    assert out == ""
    assert [line.count("needs the extra `lab`") for line in err.splitlines()] == [1, 1]
    assert err.count("pip install '.[lab]'") == 2
