"""What the commands print cannot control a terminal."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.cli import main
from uavlinkd.system.terminal import printable


@given(st.text())
def test_nothing_invisible_remains(text: str) -> None:
    """Neither a control character nor one that reverses or hides text, nor half of a surrogate pair."""
    shown = printable(text)
    assert all(unicodedata.category(each)[0] not in "C" and (each == " " or not each.isspace()) for each in shown)
    shown.encode()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("drone1 é ‥", "drone1 é ‥"),
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("a\nb\tc\r", r"a\nb\tc\r"),
        ("\x9b2J\u202e\u200b\udcff", r"\x9b2J\u202e\u200b\udcff"),
    ],
)
def test_control_characters_are_spelt_out(text: str, shown: str) -> None:
    """As Python spells them; text stays."""
    assert printable(text) == shown


def test_lines_stay_where_a_message_has_several() -> None:
    """Kept characters stay as they are."""
    assert printable("a\nb\x1b", keep="\n") == "a\nb\\x1b"


@pytest.mark.parametrize(
    "arguments",
    [
        ["fleet", "add", "x\x1b]0;title\x07"],
        ["fleet", "add", "x", "--address", "\x1b[2J:1"],
        ["fleet", "remove", "x\x1b[31m\nall is well"],
        ["fleet", "rotate", "\x9b31m"],
        ["fleet", "add", "x", "--out", "no\x1b[2J"],
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
    """Names, addresses and paths of the command line appear in errors with their control characters spelt out."""
    folder = tmp_path_factory.mktemp("fleet")
    monkeypatch.chdir(folder)
    assert main(["fleet", "init", "--drones", "1", "--out", "new"]) == 0
    monkeypatch.chdir(folder / "new")
    capfd.readouterr()
    assert main(arguments) != 0
    said = "".join(capfd.readouterr())
    assert said.replace("\n", "").isprintable()
    assert said
    assert "\nall is well" not in said
