"""The source distribution makes the wheel. A fresh environment without extras runs what a vehicle needs."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import sys
import tty
import venv
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

import pytest

from uavlinkd import __version__
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.protocol.constants import PROTOCOL_NAME

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
        (folder / "source").mkdir()
        subprocess.run(["tar", "-xf", sdist(folder), "-C", folder / "source"], check=True)
        pip(sys.executable, "wheel", "--no-deps", "--wheel-dir", folder / "wheel", sdist(folder))
        venv.create(folder / "venv")
        pip(folder / "venv/bin/python", "install", next((folder / "wheel").iterdir()))
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
    """Modules, tables and the marker of types, the two commands, and the units."""
    with zipfile.ZipFile(next((folder / "wheel").iterdir())) as wheel:
        names = set(wheel.namelist())
        entry_points = wheel.read(f"uavlinkd-{__version__}.dist-info/entry_points.txt").decode()

    units = f"uavlinkd-{__version__}.data/data/lib/systemd/system/"
    assert {name.removeprefix(units) for name in names if name.startswith(units)} == {
        path.name for path in (ROOT / "systemd").glob("*.service")
    }
    assert {name for name in names if not name.startswith(f"uavlinkd-{__version__}.")} == files("uavlinkd")
    assert "uavlinkd = uavlinkd.cli:main" in entry_points
    assert "uavlink-mitm = uavlinkd.cli:mitm" in entry_points


def test_source_has_tests_units_and_examples(folder: Path) -> None:
    """A user of the source distribution can run the tests and install the service."""
    source = folder / "source" / f"uavlinkd-{__version__}"
    names = {str(path.relative_to(source)) for path in source.rglob("*") if path.is_file()}

    assert files("uavlinkd") | files("configs") | files("systemd") | files("tests", "*.py") <= names
    assert {"README.md", "LICENSE", "CHANGELOG.md", "pyproject.toml"} <= names


def test_a_vehicle_gets_no_laboratory(folder: Path) -> None:
    """Not pymavlink; the four commands of the laboratory name the extra in one line."""
    commands = folder / "venv/bin"

    pip(commands / "python", "check")
    assert run(commands / "uavlinkd", "--version") == f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}\n"
    listed = run(sys.executable, "-m", "pip", f"--python={commands / 'python'}", "list", "--format=freeze").lower()
    assert "cryptography==" in listed
    assert not {"pymavlink"} & {line.partition("==")[0] for line in listed.splitlines()}
    for command in (["uavlinkd", "demo"], ["uavlinkd", "sim"], ["uavlinkd", "evaluate", "timing"], ["uavlink-mitm"]):
        done = subprocess.run([commands / command[0], *command[1:]], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done
        assert "needs the extra `lab`" in done.stderr
        assert "pip install '.[lab]'" in done.stderr


CONFIGURATION = """
name = "{name}"
private_key_file = "{name}.key"
listen = ["127.0.0.1:{port}"]
control_socket = "{name}.sock"
[[endpoint]]
name = "autopilot"
url = "{url}"
[[peer]]
name = "{peer}"
public_key = "{public_key}"
addresses = ["127.0.0.1:{peer_port}"]
role = "all"
system_ids = "all"
"""
HEARTBEATS = [mavlink_frame(0, bytes((0, 0, 0, 0, 2, 3, 81, 4, 3)), 50, system=number) for number in (1, 2)]


def test_daemons_carry_frames_between_udp_and_a_serial_port(folder: Path, tmp_path: Path) -> None:
    """Two daemons of the environment without extras, `check` and `status`: one endpoint is UDP, the other serial."""
    command = str(folder / "venv/bin/uavlinkd")
    ports = dict(zip("ab", free_ports(2), strict=True))
    (udp_port,) = free_ports(1)
    public = {name: run(command, "keygen", "--out", tmp_path / f"{name}.key").strip() for name in "ab"}
    master, slave = pty.openpty()
    with ExitStack() as stack:
        stack.callback(os.close, master)
        stack.callback(os.close, slave)
        tty.setraw(slave)
        os.set_blocking(master, False)
        urls = {"a": f"udpin:127.0.0.1:{udp_port}", "b": f"serial:{os.ttyname(slave)}:57600"}
        for name, peer in ("ab", "ba"):
            file = tmp_path / f"{name}.toml"
            keys = {"public_key": public[peer], "port": ports[name], "peer_port": ports[peer]}
            file.write_text(CONFIGURATION.format(name=name, peer=peer, url=urls[name], **keys))
            run(command, "check", "--config", file)
            log = stack.enter_context((tmp_path / f"{name}.log").open("wb"))
            daemon = stack.enter_context(
                subprocess.Popen(end_with_parent(command, "run", "--config", str(file)), stdout=log, stderr=log)
            )
            stack.callback(daemon.terminate)
        autopilot = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        autopilot.connect(("127.0.0.1", udp_port))
        autopilot.settimeout(0.2)
        over_serial, over_udp, until = b"", b"", monotonic() + 120
        while HEARTBEATS[0] not in over_serial or HEARTBEATS[1] not in over_udp:
            assert monotonic() < until, [(tmp_path / f"{name}.log").read_text() for name in "ab"]
            with suppress(OSError):  # the endpoint is not bound yet, or nothing has arrived
                os.write(master, HEARTBEATS[1])
                autopilot.send(HEARTBEATS[0])
                over_udp += autopilot.recv(2048)
            with suppress(BlockingIOError):
                over_serial += os.read(master, 4096)
        assert "1 of 1 peers up" in run(command, "status", "--config", tmp_path / "a.toml")
