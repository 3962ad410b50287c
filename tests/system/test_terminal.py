"""The output of the commands cannot control a terminal."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.cli import main
from uavlinkd.system.terminal import printable


@given(st.text())
def test_invisible_characters_are_escaped(text: str) -> None:
    """The output has no control character, no character that reverses or hides text, and no half surrogate pair."""
    shown = printable(text)
    assert all(
        unicodedata.category(character)[0] not in "C" and (character == " " or not character.isspace())
        for character in shown
    )
    shown.encode()


@pytest.mark.parametrize(
    "arguments",
    [
        ["fleet", "remove", "x\x1b]0;title\x07"],
        ["fleet", "sign", "x", "--address", "\x1b[2J:1"],
        ["fleet", "remove", "x\x1b[31m\nall is well"],
        ["enroll", "x\x1b[31m"],
        ["enroll", "--finish", "\x1b[31m"],
        ["fleet", "sign", "\x9b31m"],
        ["fleet", "sign", "x", "--out", "no\x1b[2J"],
        ["check", "--config", "no\x1b[31m.toml"],
        ["status", "--socket", "no\x1b[31m"],
        ["pubkey", "no\x1b[31m.key"],
    ],
)
def test_commands_do_not_echo_control_characters(
    arguments: list[str],
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Names, addresses and paths of the command line appear in errors with escaped control characters."""
    folder = tmp_path_factory.mktemp("fleet")
    monkeypatch.chdir(folder)
    assert main(["fleet", "init", "--no-passphrase"]) == 0
    capfd.readouterr()
    assert main(arguments) != 0
    said = "".join(capfd.readouterr())
    assert said.replace("\n", "").isprintable()
    assert said
    assert "\nall is well" not in said
