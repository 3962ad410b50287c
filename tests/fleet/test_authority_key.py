"""The authority's key: its passphrase, typed or from a file, and its paper copy."""

from __future__ import annotations

import os
import pty
import select
import sys
import termios
import time
from pathlib import Path

import pytest

from tests.fleet.folders import create, join
from tests.waiting import PATIENCE_S
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError
from uavlinkd.cli import main
from uavlinkd.config.keys import KeyFileError
from uavlinkd.fleet import operations
from uavlinkd.fleet.authority_key import (
    AUTHORITY_FILE,
    load_key,
    paper_copy,
    passphrase_from,
    read_paper,
)
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.fleet.signing import Identity
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.addresses import Address

PASSPHRASE = "correct horse battery staple"
INIT = ["fleet", "init"]


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with a passphrase, in the working folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "passphrase"
    path.touch(mode=0o600)
    path.write_text(f"{PASSPHRASE}\r\n")
    return path


def test_passphrase_from_a_file(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It opens the key, and is in no output. A wrong one does not."""
    assert main([*INIT, "--passphrase-file", str(file)]) == 0
    ask = passphrase_from(file)
    assert PASSPHRASE not in "".join(capsys.readouterr())
    assert main(["fleet", "paper", "--passphrase-file", str(file)]) == 0
    said = capsys.readouterr()
    assert read_paper(said.out) == load_key(Path("fleet", AUTHORITY_FILE), ask)
    assert PASSPHRASE not in "".join(said)
    file.write_text("")
    assert main(["fleet", "paper", "--passphrase-file", str(file)]) == 2
    assert capsys.readouterr().err == f"{file} is empty: it must be that of fleet/authority.pem\n"
    file.write_text("wrong\n")
    assert main(["fleet", "paper", "--passphrase-file", str(file)]) == 1
    error = capsys.readouterr().err
    for part in (
        "fleet/authority.pem cannot be used",
        "the passphrase is wrong",
        "run the command again",
        "fleet restore",
    ):
        assert part in error


@pytest.mark.parametrize(
    ("content", "mode", "reason"),
    [("", 0o600, "is empty: choose four words"), ("\n", 0o600, "is empty"), (PASSPHRASE, 0o644, "chmod 600")],
)
def test_unsafe_passphrase_file_is_refused(
    file: Path, content: str, mode: int, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the remedy; no fleet is made."""
    file.write_text(content)
    file.chmod(mode)
    assert main([*INIT, "--passphrase-file", str(file)]) != 0
    assert reason in capsys.readouterr().err
    assert not Path("fleet").exists()


def test_no_terminal_to_type_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard input may have a request, and is not read."""

    def refuse(*_: object) -> int:
        raise OSError(6, "No such device or address")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(FleetError, match="--passphrase-file FILE"):
        passphrase_from(None)("authority.pem")


@pytest.mark.long
def test_passphrase_typed_twice_on_a_terminal(tmp_path: Path) -> None:
    """The terminal does not show it, also if it is typed before the prompt. Only there, the paper copy is printed."""
    for answers, reason in (
        ((PASSPHRASE, "another"), "the two passphrases differ"),
        (("",), "the passphrase is empty"),
        ((PASSPHRASE, PASSPHRASE), "Its paper copy"),
    ):
        said = on_terminal(tmp_path, answers, early=PASSPHRASE if answers[-1] == PASSPHRASE else "")
        assert reason in said
        assert PASSPHRASE not in said
    groups = [line for line in said.splitlines() if len(line) == 34 and set(map(len, line.split())) == {4}]
    private = read_paper("\n".join(groups))
    with pytest.raises(KeyFileError, match=r"authority.pem: exists, and keys are never overwritten: move it away"):
        operations.restore(tmp_path / "fleet", private, None)
    (tmp_path / "fleet" / AUTHORITY_FILE).unlink()
    operations.restore(tmp_path / "fleet", private, None)
    station = Identity(MemberRole.OPERATOR, None, (Address("10.13.0.254", 5790),))
    join(tmp_path / "fleet", "gs", station)
    assert read_manifest(tmp_path / "fleet").member("gs").ids == "255"


def on_terminal(folder: Path, answers: tuple[str, ...], early: str) -> str:
    """What `fleet init` writes on a terminal of its own. ``early``: typed as soon as this is not shown."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.execv(sys.executable, [sys.executable, "-m", "uavlinkd", *INIT])
    said, asked = b"", 0
    while termios.tcgetattr(terminal)[3] & termios.ECHO:
        time.sleep(0.01)
    if early:
        os.write(terminal, early.encode() + b"\n")
    while select.select([terminal], [], [], PATIENCE_S)[0]:
        try:
            data = os.read(terminal, 4096)
        except OSError:  # the end
            break
        said += data
        for answer in answers[asked : said.count(b": ", 0) if b"passphrase of" in said else 0]:
            os.write(terminal, answer.encode() + b"\n")
            asked += 1
    os.close(terminal)
    os.waitpid(pid, 0)
    return said.decode().replace("\r", "")


def test_paper_copy_is_typed_back() -> None:
    """In any case and spacing; a wrong character is noticed."""
    private = Secret(bytes(range(32)))
    copy = paper_copy(private)
    assert [len(line.split()) for line in copy.splitlines()] == [7, 7]
    assert read_paper(copy.upper().replace(" ", "")) == private
    for wrong in (copy[:-1], copy.replace("a", "b", 1), copy + " aaaa", "", "é"):
        with pytest.raises(FleetError, match="wrong or missing"):
            read_paper(wrong)


def test_paper_copy_of_another_authority_is_refused(tmp_path: Path) -> None:
    """The file stays."""
    create(tmp_path / "fleet", relays=(Address("relay.example.org", 5790),))
    before = (tmp_path / "fleet" / AUTHORITY_FILE).read_bytes()
    with pytest.raises(FleetError, match="of another authority"):
        operations.restore(tmp_path / "fleet", Secret(bytes(32)), None)
    assert (tmp_path / "fleet" / AUTHORITY_FILE).read_bytes() == before
