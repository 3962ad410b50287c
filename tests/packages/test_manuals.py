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
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]

# Bash calls a function as for a Tab after the words.
PRESS_TAB = """
source "$1" && cd "$2" && shift 2
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
read -r _ _ _ _ function _ < <(complete -p "$1")
"$function" "$1" "${@: -1}" "${@: -2:1}"
echo "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with what it wrote."""
    folder = tmp_path_factory.mktemp("manuals")
    subprocess.run([sys.executable, ROOT / "systemd/deb/manuals.py", folder], check=True, cwd=ROOT)
    return folder / "share"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with a file, a fleet, and a configuration with a station."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "LICENSE").touch()
    (folder / "v7.toml").write_text('[[peer]]\nname = "taxi"\n\n[[station]]\nname = "tablet"\n')
    enroll = "uavlinkd enroll drone1 | uavlinkd fleet sign --role operator --address 127.0.0.1:5790"
    command = f"uavlinkd fleet init --no-passphrase && {enroll}"
    subprocess.run(["sh", "-c", command], check=True, cwd=folder, env=environ(), capture_output=True)
    return folder


def environ() -> dict[str, str]:
    """With the command, which the shells ask for names."""
    return {**os.environ, "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}


LINES = pytest.mark.parametrize(
    ("line", "completed"),
    [
        ("uavlinkd statu", "status"),
        ("uavlinkd status --so", "--socket"),
        ("uavlinkd fleet pub", "publish"),
        ("uavlinkd evaluate ti", "timing"),
        ("uavlinkd check --config LIC", "LICENSE"),
        ("uavlinkd fleet remove dr", "drone1"),
        ("uavlinkd fleet sign --replace dr", "drone1"),
        ("uavlinkd station remove --config v7.toml ta", "tablet"),
        ("uavlink-mitm --li", "--list"),
    ],
)


@LINES
def test_bash_completes(line: str, completed: str, share: Path, place: Path) -> None:
    """Commands, options, choices, files, members and stations."""
    script = share / "bash-completion/completions" / line.split(maxsplit=1)[0]
    command: list[str | Path] = ["bash", "-c", PRESS_TAB, "bash", script, place, *line.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environ())
    assert (done.stdout.strip(), done.stderr) == (completed, "")


@LINES
def test_fish_completes(line: str, completed: str, share: Path, place: Path) -> None:
    """The same. It adds a description to each."""
    need(shutil.which("fish") is not None, "fish")
    script = share / "fish/vendor_completions.d" / f"{line.split(maxsplit=1)[0]}.fish"
    command = ["fish", "--no-config", "--command", f"source {script}; complete --do-complete '{line}'"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=place, env=environ())
    assert (done.stdout.split()[0], done.stderr) == (completed, "")


@pytest.mark.parametrize("script", SCRIPTS)
def test_man_page_renders_without_a_warning(script: str, share: Path) -> None:
    """With the script's commands."""
    need(shutil.which("man") is not None, "man")
    command: list[str | Path] = ["man", "--warnings=all", "--local-file", share / f"man/man1/{script}.1.gz"]
    done = subprocess.run(command, capture_output=True, text=True, env={"MANWIDTH": "80"}, check=True)
    assert done.stderr == ""
    assert "--version" in done.stdout
    assert ("\nuavlinkd relay\n" in done.stdout) == (script == "uavlinkd")
