"""Images for containers: of the project's code as it is here, on whatever base this machine can have."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

HERE = Path(__file__).parent
PROJECT = HERE.parent.parent
CONTAINERS = PROJECT / "configs/containers"
PUBLIC_BASE = "debian:bookworm-slim"
LOCAL_BASES = "uavlinkd-test-base"
LOCAL_BASE = f"{LOCAL_BASES}:bookworm"
IMAGE = "uavlinkd-test"


def why_not() -> str | None:
    """Why no container can be run here, or None."""
    if shutil.which("docker") is None:
        return "docker, which is not installed"
    if subprocess.run(["docker", "info"], capture_output=True, check=False).returncode:
        return "a Docker engine that answers (docker info fails)"
    if compose_command() is None:
        return "docker compose, which is not installed"
    if os.geteuid():
        return "root, to look into the containers' network namespaces"
    if has_image(IMAGE) or has_image(LOCAL_BASE) or shutil.which("debootstrap") or pull(PUBLIC_BASE):
        return None
    return f"an image to build on: a registry that gives {PUBLIC_BASE}, or debootstrap"


def compose_command() -> list[str] | None:
    """Compose as a plugin of docker, or as a separate command."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]) and not _try(*command, "version"):
            return command
    return None


@cache
def build() -> str:
    """The image, with today's code; its name. What did not change comes from the engine's cache.

    Raises:
        subprocess.CalledProcessError: a step failed; its output was printed.
    """
    with _one_at_a_time():
        _run(sys.executable, PROJECT / "systemd/deb/make_image.py", f"--base={base_image()}", f"--tag={IMAGE}")
        return IMAGE


@contextmanager
def _one_at_a_time(kind: str = "") -> Iterator[None]:
    """Wait until no other process of the tests builds an image of this kind."""
    with (Path(tempfile.gettempdir()) / f"uavlinkd-test-images{kind}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def base_image() -> str:
    """A Debian with Python: from the registry where there is one, else from Debian's packages, with systemd too."""
    if has_image(LOCAL_BASE):
        return LOCAL_BASE
    if has_image(PUBLIC_BASE) or pull(PUBLIC_BASE):
        return PUBLIC_BASE
    return debian("bookworm")


def debian(codename: str) -> str:
    """An image of a Debian release with Python and systemd, made from Debian's packages; its name.

    Raises:
        subprocess.CalledProcessError: debootstrap failed; its output was printed.
    """
    with _one_at_a_time(f"-{codename}"):
        image = f"{LOCAL_BASES}:{codename}"
        if not has_image(image):
            _make_debian(codename, image)
        return image


def _make_debian(codename: str, image: str) -> None:
    with tempfile.TemporaryDirectory(prefix="uavlinkd-base-") as folder:
        root = Path(folder) / "root"
        # An older debootstrap does not know a newer release, which is made as "sid" is. "" is the usual mirror.
        as_sid = () if Path("/usr/share/debootstrap/scripts", codename).exists() else ("", "sid")
        packages = "--include=python3,python3-venv,systemd"
        _run("debootstrap", "--variant=minbase", packages, codename, root, *as_sid)
        leave_out = [
            f"--exclude=./{pattern}" for pattern in ("var/cache/apt/*", "var/lib/apt/lists/*", "usr/share/doc/*")
        ]
        with subprocess.Popen(["tar", "-C", root, *leave_out, "-c", "."], stdout=subprocess.PIPE) as tar:
            subprocess.run(["docker", "import", "-", image], stdin=tar.stdout, check=True, capture_output=True)


def has_image(name: str) -> bool:
    return not _try("docker", "image", "inspect", name)


def pull(name: str) -> bool:
    """Fetch it from the registry; whether that went."""
    return not _try("docker", "pull", "--quiet", name)


def _try(*command: str) -> int:
    return subprocess.run(command, capture_output=True, check=False).returncode


def _run(*command: str | Path) -> None:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        print(done.stdout)
    done.check_returncode()
