"""The source distribution makes the wheel, and a fresh environment runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from uavlinkd import __version__
from uavlinkd.core.constants import PROTOCOL_NAME

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.long


def run(*command: str | Path) -> str:
    """The output of a command that must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def pip(python: str | Path, *arguments: str | Path) -> None:
    """Run our pip for an interpreter, whose environment needs none."""
    run(sys.executable, "-m", "pip", f"--python={python}", *arguments, "--quiet")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A folder with ``sdist``, what it holds in ``source``, ``wheel``, and the environment ``venv``."""
    with TemporaryDirectory(prefix="uavlinkd-wheel-") as name:
        folder = Path(name)
        backend = folder / "backend"
        pip(sys.executable, "install", "--target", backend, "hatchling")
        build = "import hatchling.build, sys; hatchling.build.build_sdist(sys.argv[1])"
        environ = {**os.environ, "PYTHONPATH": str(backend)}
        subprocess.run([sys.executable, "-c", build, folder / "sdist"], cwd=ROOT, env=environ, check=True)
        with tarfile.open(sdist(folder)) as archive:
            archive.extractall(folder / "source", filter="data")
        pip(sys.executable, "wheel", "--no-deps", "--wheel-dir", folder / "wheel", sdist(folder))
        venv.create(folder / "venv")
        # Without bytecode: most of pymavlink's modules are never imported.
        pip(folder / "venv/bin/python", "install", "--no-compile", next((folder / "wheel").iterdir()))
        yield folder


def sdist(folder: Path) -> Path:
    """The source distribution."""
    return folder / "sdist" / f"uavlinkd-{__version__}.tar.gz"


def files(folder: str, pattern: str = "*") -> set[str]:
    """The files in one of the project's folders, but for bytecode."""
    return {
        str(path.relative_to(ROOT))
        for path in (ROOT / folder).rglob(pattern)
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_has_the_whole_package(folder: Path) -> None:
    """Modules, tables and the marker of types, and the two commands."""
    with zipfile.ZipFile(next((folder / "wheel").iterdir())) as wheel:
        names = set(wheel.namelist())
        entry_points = wheel.read(f"uavlinkd-{__version__}.dist-info/entry_points.txt").decode()

    assert {name for name in names if not name.startswith(f"uavlinkd-{__version__}.dist-info/")} == files("uavlinkd")
    assert "uavlinkd = uavlinkd.cli:main" in entry_points
    assert "uavlink-mitm = uavlinkd.lab.attacker:main" in entry_points


def test_source_has_tests_units_and_examples(folder: Path) -> None:
    """A user of the source distribution can run the tests and install the service."""
    source = folder / "source" / f"uavlinkd-{__version__}"
    names = {str(path.relative_to(source)) for path in source.rglob("*") if path.is_file()}

    assert files("uavlinkd") | files("configs") | files("systemd") | files("tests", "*.py") <= names
    assert {"README.md", "LICENSE", "CHANGELOG.md", "pyproject.toml"} <= names


def test_installed_commands_run(folder: Path) -> None:
    """Every dependency is there; the demo delivers frames."""
    commands = folder / "venv/bin"

    pip(commands / "python", "check")
    assert run(commands / "uavlinkd", "--version") == f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}\n"
    assert "replay" in run(commands / "uavlink-mitm", "--list")
    summary = json.loads(run(commands / "uavlinkd", "demo", "--seconds", "1", "--json").splitlines()[-1])
    assert summary["frames_delivered"] > 0
    assert summary["frames_altered"] == 0
