"""The commands: arguments in, exit status out."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.daemon.harness import need
from uavlinkd import __version__
from uavlinkd.config import keys
from uavlinkd.cli import FAILED, OK, WRONG, main
from uavlinkd.lab.sim import demo


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
    """A file that is there stays as it is; one line says so, status 1."""
    path = tmp_path / "some.key"
    path.write_text("precious")
    assert main([command, "--out", str(path)]) == FAILED
    assert path.read_text() == "precious"
    out, err = capsys.readouterr()
    assert out == ""
    assert str(path) in err
    assert err.count("\n") == 1


def test_keygen_without_a_file_is_a_filter(capsys: pytest.CaptureFixture[str]) -> None:
    """The private key alone goes to standard output, so that it can go into a pipe."""
    assert main(["keygen"]) == OK
    out, err = capsys.readouterr()
    private = out.removesuffix("\n")
    assert keys.public_key_text(private) in err
    assert private not in err


def test_every_key_is_another(capsys: pytest.CaptureFixture[str]) -> None:
    """Two calls give two keys."""
    for command in ("keygen", "psk"):
        main([command])
        main([command])
        first, second = capsys.readouterr().out.splitlines()
        assert first != second


def test_pubkey_reads_a_file_or_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ways give the public key that keygen printed."""
    path = tmp_path / "drone0.key"
    main(["keygen", "--out", str(path)])
    printed = capsys.readouterr().out
    assert main(["pubkey", str(path)]) == OK
    assert capsys.readouterr().out == printed
    monkeypatch.setattr(sys, "stdin", io.StringIO(path.read_text()))
    assert main(["pubkey"]) == OK
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize("text", ["", "hunter2", "A" * 43, "A" * 45, "-" * 44])
def test_pubkey_of_no_key_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """One line, which does not repeat what was given: it may be nearly a key."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    assert main(["pubkey"]) == FAILED
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert not text or text not in err


def test_pubkey_of_an_absent_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With its name."""
    assert main(["pubkey", str(tmp_path / "absent.key")]) == FAILED
    assert "absent.key" in capsys.readouterr().err


def test_keys_are_those_of_wireguard(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """``wg pubkey`` agrees with ours, and we take what ``wg genkey`` and ``wg genpsk`` make."""
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
        ["demo", "--seconds", "0"],
        ["sim", "--speed", "-1"],
        ["sim", "--speed", "nan"],
    ],
)
def test_a_wrong_command_line_gives_status_2(arguments: list[str]) -> None:
    """Whatever is wrong with it."""
    try:
        status = main(arguments)
    except SystemExit as ended:
        status = int(str(ended.code))
    assert status == WRONG


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    """``--version`` gives it and status 0."""
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == OK
    assert capsys.readouterr().out == f"uavlinkd {__version__}\n"


@pytest.mark.parametrize("command", ["run", "check", "status", "reload", "peer list"])
def test_an_absent_file_gives_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """One line with its name."""
    assert main([*command.split(), "--config", str(tmp_path / "absent.toml")]) == WRONG
    out, err = capsys.readouterr()
    assert out == ""
    assert "absent.toml" in err
    assert err.count("\n") == 1


def test_sim_flies_and_ends(capsys: pytest.CaptureFixture[str]) -> None:
    """With a time given it ends after that, with status 0 and a report."""
    assert main(["sim", "--url", "udpout:127.0.0.1:9", "--seconds", "0.1"]) == OK
    assert "frames_sent" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "names", "status"),
    [
        (["--url", "nowhere"], "nowhere", WRONG),
        (["--tlog", "absent.tlog"], "absent.tlog", FAILED),
        (["--system-id", "256"], "256", WRONG),
        (["--seconds", "nan"], "--seconds", WRONG),
    ],
)
def test_sim_that_cannot_fly_says_why(
    capsys: pytest.CaptureFixture[str], arguments: list[str], names: str, status: int
) -> None:
    """One line that names what is wrong; status 2 where it is the command line."""
    assert main(["sim", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert names in err
    assert err.count("\n") == 1


PERFECT = demo.Summary(1.0, 100, 100, 0, 2, {}, 0.2)


@pytest.mark.parametrize(
    ("summary", "status"),
    [
        (PERFECT, OK),
        (demo.Summary(1.0, 100, 99, 0, 2, {}, 0.2), FAILED),
        (demo.Summary(1.0, 100, 100, 1, 2, {}, 0.2), FAILED),
        (demo.Summary(1.0, 0, 0, 0, 2, {}, None), FAILED),
    ],
)
def test_the_demo_passes_only_when_every_frame_did(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, summary: demo.Summary, status: int
) -> None:
    """A frame lost, a frame altered, or none sent: status 1. The last line is the summary either way."""

    async def run_demo(seconds: float, *, show: bool, attack: str | None) -> demo.Summary:
        assert (seconds, show, attack) == (7.0, False, None)
        return summary

    monkeypatch.setattr(demo, "run_demo", run_demo)
    assert main(["demo", "--seconds", "7", "--json"]) == status
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["frames_sent"] == summary.frames_sent


def test_a_demo_that_cannot_start_says_why(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 1 and the reason."""

    async def run_demo(seconds: float, *, show: bool, attack: str | None) -> demo.Summary:
        raise demo.DemoError("no room")

    monkeypatch.setattr(demo, "run_demo", run_demo)
    assert main(["demo", "--json"]) == FAILED
    assert capsys.readouterr() == ("", "no room\n")


def test_pubkey_of_bytes_is_refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A key as raw bytes is no text: one line, no traceback."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\xff\xfe" + bytes(30)), encoding="utf-8"))
    assert main(["pubkey"]) == FAILED
    assert capsys.readouterr().err.startswith("standard input: is no key")


_SERVICE = """
name = "drone0"
private_key_file = "drone0.key"
control_socket = "control.sock"

[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"

[[peer]]
name = "drone1"
public_key = "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE="
addresses = ["10.13.0.2:5790"]
role = "swarm-member"
system_ids = [2]
"""


def test_check_looks_for_a_services_keys_where_it_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The keys of a service lie in a folder of their own; without --keys the message says how to name it."""
    (tmp_path / "keys").mkdir()
    assert main(["keygen", "--out", str(tmp_path / "keys" / "drone0.key")]) == OK
    path = tmp_path / "drone0.toml"
    path.write_text(_SERVICE)
    assert main(["check", "--config", str(path)]) == WRONG
    assert f"--keys {tmp_path / 'keys'}" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "absent")]) == WRONG
    assert "--keys" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "keys")]) == OK


def test_a_daemon_is_asked_without_its_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of its configuration, status, reload and peer list need the socket alone; the rest may be wrong by now."""
    path = tmp_path / "drone0.toml"
    path.write_text(_SERVICE.replace("system_ids = [2]", "system_ids = [900]"))
    assert main(["status", "--config", str(path)]) == FAILED
    assert capsys.readouterr().err.startswith(f"no daemon answers at {tmp_path / 'control.sock'}")
    path.write_text(_SERVICE.replace('"control.sock"', "7"))
    assert main(["status", "--config", str(path)]) == WRONG
    assert "control_socket" in capsys.readouterr().err


def test_the_checker_imports_nothing_from_the_current_folder(tmp_path: Path) -> None:
    """Where `uavlinkd run` is called, a file of a module's name is no module of it."""
    (tmp_path / "tomllib.py").write_text("raise SystemExit('imported from the current folder')")
    script = shutil.which("uavlinkd", path=str(Path(sys.executable).parent))
    need(script is not None, "uavlinkd, installed beside this Python")
    assert script is not None
    (tmp_path / "empty.toml").write_text("")
    command = [script, "run", "--config", "empty.toml"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == WRONG
    assert "private_key_file: is missing" in ended.stderr
    assert "current folder" not in ended.stderr
