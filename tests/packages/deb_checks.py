"""The tests of a Debian package: built, installed in a clean Debian under systemd, upgraded under traffic, purged.

Each release has a module of its own, so that two workers share them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.compose import images
from tests.compose.machine import Machine, build_clean
from tests.needs import need
from tests.processes.frames import numbered
from uavlinkd import __version__
from uavlinkd.protocol.constants import PROTOCOL_NAME

__all__ = [
    "machine",
    "package",
    "test_installation_by_hand_is_refused",
    "test_package_holds_what_a_vehicle_needs",
    "test_two_builds_are_equal",
    "test_upgrade_and_downgrade_under_traffic",
]

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "systemd/deb/make_deb.py"
CODENAMES = {12: "bookworm", 13: "trixie"}
PYTHONS = {12: ("3.11", "3.12"), 13: ("3.13", "3.14")}
NEWER = f"{__version__}+newer"
EPOCH = "1700000000"
VARIABLE = ("root", "var/backups", "var/cache", "var/log", "var/tmp")


@dataclass(frozen=True)
class Package:
    """The package of one release, built twice, and one of a later version."""

    release: int
    root: Path
    first: Path
    second: Path
    newer: Path


@pytest.fixture(scope="module")
def package(request: pytest.FixtureRequest) -> Iterator[Package]:
    """The package of the module's ``RELEASE``, built twice in one root, with two settings of the user's."""
    why = images.why_not()
    need(why is None, str(why))
    need(shutil.which("debootstrap") is not None, "debootstrap")
    release: int = request.module.RELEASE
    with TemporaryDirectory(prefix="uavlinkd-test-deb-") as name:
        folder = Path(name)
        export_root(images.debian(CODENAMES[release]), folder / "root")
        first = build(release, folder, "first", umask=0o022, TZ="UTC", LC_ALL="C.UTF-8")
        second = build(release, folder, "second", umask=0o077, TZ="Asia/Tokyo", LC_ALL="C")
        yield Package(release, folder / "root", first, second, make_newer(first, folder))


@pytest.fixture
def machine(package: Package) -> Iterator[Machine]:
    """A clean one of the package's release, with the packages in /root."""
    with Machine(build_clean(CODENAMES[package.release])) as machine:
        machine.put(package.first, "/root/uavlinkd.deb")
        machine.put(package.newer, "/root/newer.deb")
        yield machine


def export_root(image: str, root: Path) -> None:
    """Unpack an image into a folder."""
    root.mkdir()
    container = call("docker", "create", image, "true").strip()
    try:
        with subprocess.Popen(["docker", "export", container], stdout=subprocess.PIPE) as export:
            subprocess.run(["tar", "-C", root, "-x"], stdin=export.stdout, check=True)
    finally:
        call("docker", "rm", container)


def build(release: int, folder: Path, name: str, *options: str, umask: int, **environ: str) -> Path:
    """Run the command of the README, in a root that exists."""
    places = (f"--root={folder / 'root'}", f"--out={folder / name}")
    done = subprocess.run(
        [sys.executable, SCRIPT, f"--release={release}", *places, *options],
        env={**os.environ, **environ, "SOURCE_DATE_EPOCH": EPOCH},
        capture_output=True,
        text=True,
        check=False,
        umask=umask,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    print(done.stdout)
    (deb,) = (folder / name).iterdir()
    return deb


def make_newer(deb: Path, folder: Path) -> Path:
    """A package of a later version, whose code says so."""
    tree, newer = folder / "tree", folder / "newer.deb"
    call("dpkg-deb", "--raw-extract", str(deb), str(tree))
    control = tree / "DEBIAN/control"
    control.write_text(control.read_text().replace(f"Version: {__version__}-1", f"Version: {__version__}-2"))
    (module,) = tree.glob("opt/uavlinkd/lib/python3.*/site-packages/uavlinkd/__init__.py")
    module.write_text(module.read_text().replace(f'"{__version__}"', f'"{NEWER}"'))
    for bytecode in module.parent.glob("__pycache__/__init__.*"):
        bytecode.unlink()
    call("dpkg-deb", "--root-owner-group", "-Zgzip", "-z1", "--build", str(tree), str(newer))
    return newer


def call(*command: str) -> str:
    """The output of a command that must succeed."""
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


def files(machine: Machine) -> set[str]:
    """All paths of its disk, but for the package manager's records, logs and what the machine writes as it runs."""
    places = (*(f"var/lib/{name}" for name in ("apt", "dpkg", "systemd")), *VARIABLE)
    leave_out = " -o ".join(f"-path /{place}" for place in places)
    listed = f"find / -xdev \\( {leave_out} \\) -prune -o -print"
    # Twice: a container's file system may leave a path out of a large folder's list. A file may vanish meanwhile.
    return set(machine.say(f"{listed} || true; {listed} || true").splitlines())


def test_two_builds_are_equal(package: Package) -> None:
    """Byte for byte, whatever the user's mask, language and time zone, and the folder of the build."""
    assert package.first.read_bytes() == package.second.read_bytes()


def test_package_holds_what_a_vehicle_needs(package: Package) -> None:
    """Its Python and no other, neither pip nor the laboratory; root owns every file and only root writes."""
    lowest, beyond = PYTHONS[package.release]
    depends = call("dpkg-deb", "--field", str(package.first), "Depends").strip()
    listing = [line.split(None, 5) for line in call("dpkg-deb", "--contents", str(package.first)).splitlines()]
    names = {fields[5].split(" -> ")[0] for fields in listing}
    packages = {name.split("/site-packages/")[1].split("/")[0] for name in names if "/site-packages/" in name}
    print(f"{package.first.name}: {package.first.stat().st_size / 1e6:.1f} MB")
    print(call("dpkg-deb", "--field", str(package.first), "Installed-Size"))

    assert depends == f"python3 (>= {lowest}), python3 (<< {beyond})"
    assert {"uavlinkd", "uvloop", "cryptography", "rich"} <= packages
    assert not {"pip", "setuptools", "pymavlink"} & packages
    assert not [name for name in names if "/uavlinkd/lab" in name]
    assert {fields[1] for fields in listing} == {"root/root"}
    assert {fields[0] for fields in listing} <= {"drwxr-xr-x", "drwx------", "-rw-r--r--", "-rwxr-xr-x", "lrwxrwxrwx"}
    shared = ("man/man1/uavlinkd.1.gz", "bash-completion/completions/uavlinkd", "zsh/vendor-completions/_uavlinkd")
    installed = ("lib/systemd/system/uavlinkd.service", "bin/uavlinkd", *(f"share/{path}" for path in shared))
    assert {f"./usr/{path}" for path in installed} <= names


def test_installation_by_hand_is_refused(package: Package, machine: Machine) -> None:
    """Without a change. After the printed commands it installs, enables no service, and a purge leaves no trace."""
    before = files(machine)
    machine.say("mkdir /opt/uavlinkd; echo mine >/opt/uavlinkd/file")

    refused = machine.run("dpkg --install /root/uavlinkd.deb")

    assert refused.returncode != 0
    assert "no package made it" in refused.stderr
    assert "rm -r /opt/uavlinkd" in refused.stderr
    assert machine.say("cat /opt/uavlinkd/file; ls /opt/uavlinkd") == "mine\nfile\n"
    assert files(machine) - before == {"/opt/uavlinkd", "/opt/uavlinkd/file"}

    machine.say("rm -r /opt/uavlinkd; dpkg --install /root/uavlinkd.deb")
    assert machine.say("uavlinkd --version").strip() == f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}"
    assert machine.say("dpkg --verify uavlinkd") == ""
    for unit in ("uavlinkd.service", "uavlinkd@.service", "uavlinkd-relay.service", "uavlinkd-web.service"):
        assert machine.run(f"systemctl is-enabled {unit}").stdout.strip() in {"disabled", "static"}
    for command in ("uavlinkd demo", "uavlinkd sim", "uavlinkd evaluate", "/opt/uavlinkd/bin/uavlink-mitm"):
        without = machine.run(command)
        assert (without.returncode, without.stderr.count("\n")) == (1, 1)
        assert "needs the extra `lab`" in without.stderr
    assert "private keys" not in purge(machine)
    left = files(machine)
    gone = sorted(before - left - {"/opt"})  # the package manager removes this folder, if it is empty
    assert left <= before
    assert not [path for path in gone if machine.run(f"test -e '{path}' || test -L '{path}'").returncode]


CONFIGURE = """
configure() {
    install -d -m 0700 /etc/uavlinkd/$1
    uavlinkd keygen --out /etc/uavlinkd/$1/$1.key >/root/$1.pub
    cat >/etc/uavlinkd/$1.toml <<END
name = "$1"
private_key_file = "$1.key"
listen = ["127.0.0.1:$3"]
control_socket = "/run/uavlinkd/$1/control.sock"
[[endpoint]]
name = "autopilot"
url = "$5"
[[peer]]
name = "$2"
public_key = "PUBLIC_KEY_OF_$2"
addresses = ["127.0.0.1:$4"]
role = "$6"
system_ids = [$7]
END
}
configure a b 5790 5791 udpin:127.0.0.1:14550 operator 255
configure b a 5791 5790 udpout:127.0.0.1:14551 vehicle 1
for name in a b; do sed -i "s#PUBLIC_KEY_OF_$name#$(cat /root/$name.pub)#" /etc/uavlinkd/*.toml; done
systemctl enable --now uavlinkd@a uavlinkd@b
systemd-run --quiet --unit=traffic --property=StandardInput=file:/root/frames \\
    /usr/bin/python3 /root/traffic.py 14550 14551 /root/times
"""


def test_upgrade_and_downgrade_under_traffic(package: Package, machine: Machine, tmp_path: Path) -> None:
    """Both daemons restart with the other code. A removal keeps configuration and keys."""
    (tmp_path / "frames").write_text("".join(f"{numbered(number, 1).hex()}\n" for number in range(256)))
    machine.put(tmp_path / "frames", "/root/frames")
    machine.put(Path(__file__).with_name("traffic.py"), "/root/traffic.py")
    machine.say("dpkg --install /root/uavlinkd.deb")
    machine.say(CONFIGURE)
    machine.until(lambda: len(arrivals(machine)) > 20)
    mine = machine.say("find /etc/uavlinkd -type f -exec sha256sum {} +")

    for deb, version in (("newer", NEWER), ("uavlinkd", __version__)):
        before = {name: machine.show(f"uavlinkd@{name}", "MainPID") for name in "ab"}
        count = len(arrivals(machine))
        machine.say(f"dpkg --install /root/{deb}.deb")
        installed = len(arrivals(machine))
        machine.until(lambda installed=installed: len(arrivals(machine)) > installed + 20)  # type: ignore[misc]

        outage_s = max(later - earlier for earlier, later in pairwise(arrivals(machine)[count - 1 :]))
        print(f"Debian {package.release}, to {version}: no frame for {outage_s:.1f} s")
        assert machine.say("uavlinkd --version").strip() == f"uavlinkd {version}, {PROTOCOL_NAME.decode()}"
        assert all(machine.show(f"uavlinkd@{name}", "MainPID") not in ("0", before[name]) for name in "ab")
        machine.until(lambda: all(is_up(machine, name) for name in "ab"))
        assert machine.say("find /etc/uavlinkd -type f -exec sha256sum {} +") == mine

    machine.say("systemctl stop traffic; dpkg --remove uavlinkd")
    assert machine.show("uavlinkd@a", "ActiveState") == "inactive"
    assert machine.say("find /etc/uavlinkd -type f -exec sha256sum {} +") == mine
    assert machine.run("ls /opt/uavlinkd /usr/bin/uavlinkd").stdout == ""
    keys = machine.say("cat /etc/uavlinkd/?/?.key").split()

    said = purge(machine)

    assert all(f"/etc/uavlinkd/{name}/{name}.key" in said for name in "ab")
    assert not any(key in said for key in keys)
    left = {path for path in files(machine) if "uavlink" in path}
    assert left == {
        "/etc/uavlinkd",
        *(f"/etc/uavlinkd/{end}" for n in "ab" for end in (n, f"{n}.toml", f"{n}/{n}.key")),
    }


def is_up(machine: Machine, name: str) -> bool:
    """Whether a daemon reports that its peer is up."""
    return machine.show(f"uavlinkd@{name}", "StatusText").startswith("1 of 1 peers up")


def arrivals(machine: Machine) -> list[float]:
    """When frames arrived, in seconds."""
    return [
        float(line) for line in machine.run("cat /root/times").stdout.splitlines(keepends=True) if line[-1:] == "\n"
    ]


def purge(machine: Machine) -> str:
    """What a purge prints."""
    done = machine.run("dpkg --purge uavlinkd")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr
