"""The wheel on newer Pythons: those of Debian's next release, in a container."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.compose import images
from tests.needs import need

ROOT = Path(__file__).parents[2]
PYTHON = "3.14"

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def wheels() -> Iterator[Path]:
    """A folder with the wheel of uavlinkd and those that it needs on the newer Python, with the laboratory."""
    why = images.why_not()
    need(why is None, str(why))
    with TemporaryDirectory(prefix="uavlinkd-newer-python-") as name:
        folder = Path(name)
        pip("wheel", "--no-deps", f"--wheel-dir={folder}", ROOT)
        (wheel,) = folder.iterdir()
        selection = ("--only-binary=:all:", f"--python-version={PYTHON}", f"--dest={folder}")
        pip("download", *selection, f"{wheel}[lab,speed]")
        yield folder


def pip(*arguments: str | Path) -> None:
    """Run our pip, which must succeed."""
    command = (sys.executable, "-m", "pip", "--quiet", *arguments)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_demo_delivers_every_frame(wheels: Path) -> None:
    """A virtual environment of wheels alone, made with the distribution's own Python, needs no compiler."""
    install = f"python{PYTHON} -m venv /venv && /venv/bin/pip install -q --no-index --find-links /wheels"
    script = f"{install} 'uavlinkd[lab,speed]' >&2 && /venv/bin/uavlinkd demo --seconds 2 --json"
    command = ("docker", "run", "--rm", "--network=none", f"--volume={wheels}:/wheels:ro", images.debian("forky"))
    done = subprocess.run([*command, "sh", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert (shown["frames_delivered"], shown["frames_altered"]) == (shown["frames_sent"], 0)
    assert shown["frames_sent"] > 0
