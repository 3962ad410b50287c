"""Shell completions and man pages of the console scripts, as ``systemd/deb/manuals.py`` makes them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.needs import need

ROOT = Path(__file__).parents[2]
SCRIPTS = {
    "uavlinkd": {"uavlinkd run", "uavlinkd psk", "uavlinkd sim", "uavlinkd evaluate report", "uavlinkd fleet rotate"},
    "uavlink-mitm": {"uavlink-mitm modem", "uavlink-mitm relay"},
}
"""Each console script, with some of its commands."""

# Bash calls a function as for a Tab after the words.
PRESS_TAB = """
source "$1" && cd "$2" && shift 2
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMP_LINE="$*" COMP_POINT=${#COMP_LINE}
read -r _ _ _ _ function _ < <(complete -p "$1")
"$function" "$1" "${@: -1}" "${@: -2:1}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with what it wrote."""
    folder = tmp_path_factory.mktemp("manuals")
    subprocess.run([sys.executable, ROOT / "systemd/deb/manuals.py", folder], check=True, cwd=ROOT)
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert (
        set(SCRIPTS)
        == set(scripts)
        == {file.name for file in (folder / "share/bash-completion/completions").iterdir()}
    )
    return folder / "share"


@pytest.mark.parametrize(
    ("line", "completed"),
    [
        ("uavlinkd st", {"status"}),
        ("uavlinkd status --so", {"--socket"}),
        ("uavlinkd peer ", {"list"}),
        ("uavlinkd fleet ro", {"rotate"}),
        ("uavlinkd evaluate re", {"report"}),
        ("uavlinkd check --config dro", {"drone0.toml"}),
        ("uavlink-mitm mo", {"modem"}),
        ("uavlink-mitm relay --li", {"--list"}),
    ],
)
def test_bash_completes(line: str, completed: set[str], share: Path, tmp_path: Path) -> None:
    """Commands, options, choices and files."""
    (tmp_path / "drone0.toml").touch()
    words = line.split(" ")
    script = share / "bash-completion/completions" / words[0]
    done = subprocess.run(
        ["bash", "-c", PRESS_TAB, "bash", script, tmp_path, *words], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert {word.strip() for word in done.stdout.splitlines()} - {"-h", "--help"} == completed


@pytest.mark.parametrize("command", SCRIPTS)
def test_man_page_names_all_commands_and_renders_without_a_warning(command: str, share: Path) -> None:
    """In 80 columns."""
    need(shutil.which("man") is not None, "man")
    environ = {**os.environ, "MANWIDTH": "80", "LC_ALL": "C.UTF-8"}
    page = share / f"man/man1/{command}.1.gz"
    done = subprocess.run(
        ["man", "--warnings=all", "--local-file", page], capture_output=True, text=True, env=environ, check=True
    )
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert SCRIPTS[command] <= set(lines)
