"""The package of Debian 12: the tests of ``deb_checks.py``, and its package of arm64 in a Debian of arm64."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import need
from tests.packages.deb_checks import *  # noqa: F403
from tests.packages.deb_checks import ROOT, Package, build
from tests.walkthroughs.raspberry_pi import *  # noqa: F403

RELEASE = 12
pytestmark = pytest.mark.long

IMAGE_LOCK = ROOT / "systemd/deb/image.lock"
SELECTION = ("--python-version=3.11", "--implementation=cp", "--only-binary=:all:", "--no-deps")
PLATFORMS = [f"--platform=manylinux_2_{minor}_aarch64" for minor in (17, 28)]


def test_package_of_arm64_carries_frames(package: Package, tmp_path: Path) -> None:
    """Built here, unpacked in a Debian of arm64, and run by qemu; the laboratory is added for its demo."""
    need(bool(os.environ.get("UAVLINKD_ARM64")), "minutes of emulation: set UAVLINKD_ARM64=1")
    need(shutil.which("qemu-aarch64-static") is not None, "qemu-user-static")
    emulator = Path("/proc/sys/fs/binfmt_misc/qemu-aarch64")
    need(emulator.exists(), "programs of arm64 to run by qemu: update-binfmts --enable qemu-aarch64")
    deb = build(RELEASE, package.root.parent, "arm64", "--architecture=arm64", umask=0o022)
    root = tmp_path / "root"
    call("debootstrap", "--arch=arm64", "--foreign", "--variant=minbase", "--include=python3", "bookworm", str(root))
    for path in [*root.glob("var/cache/apt/archives/*.deb"), deb]:
        unpack(path, root)
    add_laboratory(root, tmp_path / "added")

    # In a namespace of their own, mounts end with the command.
    mounts = f"mount --rbind /dev {root}/dev && mount -t proc proc {root}/proc"
    demo = f"exec chroot {root} /usr/bin/uavlinkd demo --seconds 6 --json"
    shown = json.loads(
        call("unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", f"{mounts} && {demo}")
    )

    print(shown)
    assert (shown["frames_delivered"], shown["frames_altered"]) == (shown["frames_sent"], 0)
    assert shown["frames_sent"] > 0


def unpack(deb: Path, root: Path) -> None:
    """Unpack a package without running its scripts, which emulation makes slow."""
    with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE) as files:
        subprocess.run(["tar", "-C", root, "-x", "--keep-directory-symlink"], stdin=files.stdout, check=True)


def add_laboratory(root: Path, added: Path) -> None:
    """Add to the package's environment what the demo needs beyond it."""
    target = (f"--target={added}", "--no-compile", "--require-hashes", f"--requirement={IMAGE_LOCK}")
    call(sys.executable, "-m", "pip", "install", "--quiet", *SELECTION, *PLATFORMS, *target)
    (packages,) = root.glob("opt/uavlinkd/lib/python3.*/site-packages")
    for path in added.iterdir():
        if not (packages / path.name).exists():
            os.rename(path, packages / path.name)
    shutil.copytree(ROOT / "uavlinkd/lab", packages / "uavlinkd/lab")


def call(*command: str) -> str:
    """The output of a command that must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
