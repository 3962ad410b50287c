"""The command line of the man in the middle: what is wrong is said in one line each, with status 2."""

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
        ([], "stands between two peers"),
        (PAIR[:2], "name the two peers of a link"),
        ([*PAIR, "--attack=misroute"], "three peers"),
        ([*PAIR, "--attack=drop,way=a>z"], "way is both"),
        ([*PAIR, "--radio=way=a>z"], "way is both"),
        ([*PAIR, "--seconds=0"], "--seconds"),
        ([*PAIR, "--seconds=nan"], "--seconds"),
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


@pytest.mark.parametrize("flag", ["--attack=dropp", "--radio=loss=9", "--peer=x", "--link=a"])
def test_flag_that_cannot_be_read_is_explained(flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    """By argparse, with what the parser has to say."""
    with pytest.raises(SystemExit) as caught:
        main([*PAIR, flag])
    assert caught.value.code == 2
    assert flag.partition("=")[0] in capsys.readouterr().err


def test_nobody_to_ask_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line says where."""
    assert main([f"--control-socket={tmp_path / 'none'}", "--ask=statistics"]) == 1
    assert "no daemon answers" in capsys.readouterr().err


def test_log_that_cannot_be_written_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And no traceback."""
    assert main([*PAIR, f"--log={tmp_path}"]) == 1
    assert "cannot write the log" in capsys.readouterr().err
