"""The command line of the man in the middle: one line per problem, and status 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.lab.mitm.attacks import ATTACKS
from uavlinkd.lab.mitm.cli import main

PAIR = ["--peer=a=127.0.0.1:1", "--peer=b=127.0.0.1:2", "--link=a@127.0.0.1:3,b@127.0.0.1:4"]


def test_list_prints_every_attack(capsys: pytest.CaptureFixture[str]) -> None:
    """Each name at the beginning of a line."""
    assert main(["--list"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert {line.partition(" ")[0] for line in printed} >= set(ATTACKS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "at least two peers are required"),
        (PAIR[:2], "at least one link is required"),
        ([*PAIR, "--attack=misroute"], "three peers"),
        ([*PAIR, "--attack=drop,direction=a>z"], "direction must be both"),
        ([*PAIR, "--radio=direction=a>z"], "direction must be both"),
        (["--ask=statistics"], "--control-socket"),
        (["--config=/nowhere.toml"], "cannot be read"),
    ],
)
def test_wrong_command_line_ends_with_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is opened."""
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "flag", ["--attack=dropp", "--radio=loss=9", "--peer=x", "--link=a", "--seconds=0", "--seconds=nan"]
)
def test_flag_that_cannot_be_read_is_explained(flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    """argparse shows the message of the parser."""
    with pytest.raises(SystemExit) as caught:
        main([*PAIR, flag])
    assert caught.value.code == 2
    assert flag.partition("=")[0] in capsys.readouterr().err


def test_no_running_proxy_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line names the socket."""
    assert main([f"--control-socket={tmp_path / 'none'}", "--ask=statistics"]) == 1
    assert "no daemon answers" in capsys.readouterr().err


def test_log_that_cannot_be_written_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And no traceback."""
    assert main([*PAIR, f"--log={tmp_path}"]) == 1
    assert "cannot write the log" in capsys.readouterr().err
