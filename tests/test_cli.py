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
from uavlinkd.cli import FAILED, OK, WRONG, main
from uavlinkd.config import keys
from uavlinkd.core.constants import PROTOCOL_NAME
from uavlinkd.lab.sim import demo, demo_results


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


def test_keygen_without_a_file_is_a_filter(capsys: pytest.CaptureFixture[str]) -> None:
    """The private key alone goes to standard output, so that it can go into a pipe."""
    assert main(["keygen"]) == OK
    out, err = capsys.readouterr()
    private = out.removesuffix("\n")
    assert keys.public_key_text(private) in err
    assert private not in err


def test_pubkey_reads_a_file_or_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both print the public key that keygen printed."""
    path = tmp_path / "drone0.key"
    main(["keygen", "--out", str(path)])
    printed = capsys.readouterr().out
    assert main(["pubkey", str(path)]) == OK
    assert capsys.readouterr().out == printed
    monkeypatch.setattr(sys, "stdin", io.StringIO(path.read_text()))
    assert main(["pubkey"]) == OK
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize("text", ["", "hunter2", "A" * 43, "A" * 45, "-" * 44])
def test_pubkey_of_an_invalid_key_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """One line, which does not repeat the input: it may be almost a key."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    assert main(["pubkey"]) == FAILED
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert not text or text not in err


def test_pubkey_of_an_absent_file_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The message has the file's name."""
    assert main(["pubkey", str(tmp_path / "absent.key")]) == FAILED
    assert "absent.key" in capsys.readouterr().err


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
        ["sim", "--speed", "-1"],
        ["sim", "--speed", "nan"],
    ],
)
def test_a_wrong_command_line_gives_status_2(arguments: list[str]) -> None:
    """Status 2 for a missing, unknown or invalid argument."""
    try:
        status = main(arguments)
    except SystemExit as ended:
        status = int(str(ended.code))
    assert status == WRONG


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """``--version`` prints it and that of the protocol, which must be equal at both ends, with status 0."""
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == OK
    assert capsys.readouterr().out == f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}\n"


@pytest.mark.parametrize("command", ["run", "check", "status", "reload", "peer list"])
def test_an_absent_file_gives_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """One line with the file's name."""
    assert main([*command.split(), "--config", str(tmp_path / "absent.toml")]) == WRONG
    out, err = capsys.readouterr()
    assert out == ""
    assert "absent.toml" in err
    assert err.count("\n") == 1


def test_sim_flies_and_ends(capsys: pytest.CaptureFixture[str]) -> None:
    """With ``--seconds`` it ends by itself, with status 0 and a report."""
    assert main(["sim", "--url", "udpout:127.0.0.1:9", "--seconds", "0.1"]) == OK
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "copter with system ID 1, sends to udpout:127.0.0.1:9; Ctrl-C ends it"
    assert re.fullmatch(r"sent \d+ frames, received 0 in \d+\.\d s", last)


@pytest.mark.parametrize(
    ("arguments", "names", "status"),
    [
        (["--url", "nowhere"], "nowhere", WRONG),
        (["--url", "udp:127.0.0.1:14550"], "write udpin:127.0.0.1:14550 to listen there", WRONG),
        (["--tlog", "absent.tlog"], "cannot read absent.tlog: No such file or directory", FAILED),
        (["--system-id", "256"], "256", WRONG),
        (["--seconds", "nan"], "--seconds", WRONG),
    ],
)
def test_sim_that_cannot_fly_reports_the_reason(
    capsys: pytest.CaptureFixture[str], arguments: list[str], names: str, status: int
) -> None:
    """One line names the wrong value; status 2 if the command line is wrong."""
    assert main(["sim", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert names in err
    assert err.count("\n") == 1


PERFECT = demo_results.Summary(1.0, 100, 100, 0, 2, {}, 0.2)


@pytest.mark.parametrize(
    ("summary", "status"),
    [
        (PERFECT, OK),
        (demo_results.Summary(1.0, 100, 99, 0, 2, {}, 0.2), FAILED),
        (demo_results.Summary(1.0, 100, 100, 1, 2, {}, 0.2), FAILED),
        (demo_results.Summary(1.0, 0, 0, 0, 2, {}, None), FAILED),
    ],
)
def test_the_demo_succeeds_only_if_every_frame_arrived(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, summary: demo_results.Summary, status: int
) -> None:
    """A frame lost, a frame altered, or no frame sent: status 1. The last line is always the summary."""

    async def run_demo(seconds: float, *, show: bool, attack: str | None) -> demo_results.Summary:
        assert (seconds, show, attack) == (7.0, False, None)
        return summary

    monkeypatch.setattr(demo, "run_demo", run_demo)
    assert main(["demo", "--seconds", "7", "--json"]) == status
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["frames_sent"] == summary.frames_sent


def test_a_demo_that_cannot_start_reports_the_reason(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 1 and the reason."""

    async def run_demo(seconds: float, *, show: bool, attack: str | None) -> demo_results.Summary:
        raise demo.DemoError("no room")

    monkeypatch.setattr(demo, "run_demo", run_demo)
    assert main(["demo", "--json"]) == FAILED
    assert capsys.readouterr() == ("", "no room\n")


def test_pubkey_of_bytes_is_refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A key as raw bytes is not text: one line, no traceback."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\xff\xfe" + bytes(30)), encoding="utf-8"))
    assert main(["pubkey"]) == FAILED
    assert capsys.readouterr().err.startswith("standard input: is not a key")


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


def test_check_reads_a_services_keys_from_their_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A service has its keys in a separate folder; without ``--keys`` the message shows the option."""
    (tmp_path / "keys").mkdir()
    assert main(["keygen", "--out", str(tmp_path / "keys" / "drone0.key")]) == OK
    path = tmp_path / "drone0.toml"
    path.write_text(_SERVICE)
    assert main(["check", "--config", str(path)]) == WRONG
    assert f"--keys {tmp_path / 'keys'}" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "absent")]) == WRONG
    assert "--keys" in capsys.readouterr().err
    assert main(["check", "--config", str(path), "--keys", str(tmp_path / "keys")]) == OK


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
    assert "control_socket" in capsys.readouterr().err


def test_evaluate_lists_its_evaluations(capsys: pytest.CaptureFixture[str]) -> None:
    """The parser imports their definitions only now, and its help has them."""
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "--help"])
    assert ended.value.code == OK
    assert "tampering" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["demo", "sim"])
def test_missing_pymavlink_is_reported(command: str) -> None:
    """The Debian package has no pymavlink: the message names the remedy."""
    hide = "import sys; sys.modules['pymavlink'] = None"
    code = f"{hide}; from uavlinkd.cli import main; sys.exit(main(['{command}']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)

    assert done.returncode == FAILED
    assert "pip install ." in done.stderr
    assert "Traceback" not in done.stderr
