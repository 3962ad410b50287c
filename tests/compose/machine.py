"""A machine with systemd: a container in which it is the first process, with the units and uavlinkd installed."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.compose import images
from tests.waiting import PATIENCE_S

IMAGE = "uavlinkd-test-systemd"
_DOCKERFILE = """
FROM {image}
USER root
{steps}
COPY start-systemd /sbin/
ENV container=docker
HEALTHCHECK NONE
STOPSIGNAL SIGRTMIN+3
ENTRYPOINT []
CMD ["/sbin/start-systemd"]
"""
_UNITS = "COPY *.service /etc/systemd/system/\nCOPY mitm.toml /etc/uavlinkd/\n"
_INSTALL = "RUN apt-get update -qq && apt-get install -qq -y --no-install-recommends systemd"


def build() -> str:
    """The image, with today's code and units; its name.

    Raises:
        subprocess.CalledProcessError: a step failed.
    """
    image = images.build()
    # The base that the tests made has systemd. One that was pulled has a network to install it from.
    install = "" if images.base_image() == images.LOCAL_BASE else _INSTALL
    units = (images.PROJECT / "systemd").glob("*.service")
    return _build(IMAGE, image, _UNITS + install, images.PROJECT / "configs" / "mitm.toml", *units)


def build_clean(codename: str) -> str:
    """The image of a Debian release without uavlinkd, and without what only a build needs; its name.

    Raises:
        subprocess.CalledProcessError: a step failed.
    """
    packages = "$(dpkg-query --show --showformat='${Package}\\n' | grep -E '^python3.*-(venv|whl)$')"
    return _build(f"{IMAGE}:{codename}", images.debian(codename), f"RUN dpkg --purge {packages}")


def _build(name: str, image: str, steps: str, *files: Path) -> str:
    with tempfile.TemporaryDirectory(prefix="uavlinkd-machine-") as folder:
        context = Path(folder)
        for path in [images.HERE / "start-systemd", *files]:
            shutil.copy(path, context)
        (context / "Dockerfile").write_text(_DOCKERFILE.format(image=image, steps=steps))
        _call("docker", "build", "--quiet", "--tag", name, folder)
    return name


class Machine:
    """One that runs. Commands in it run as root."""

    def __init__(self, image: str) -> None:
        self._image = image
        self._id = ""

    def __enter__(self) -> Self:
        # All that a machine's root may, but for one capability that not every engine has to give.
        self._id = _call(
            *("docker", "run", "--detach", "--cap-add=ALL", "--cap-drop=SYS_RESOURCE"),
            *("--security-opt=seccomp=unconfined", "--security-opt=apparmor=unconfined", "--network=none"),
            *("--tmpfs=/run:exec", "--tmpfs=/run/lock", "--tmpfs=/tmp", self._image),
        ).strip()
        self.until(lambda: self.say("systemctl is-system-running || true").strip() in ("running", "degraded"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            print(self.say("journalctl --no-pager --output=cat --lines=60 || true"))
        _call("docker", "rm", "--force", self._id)

    def run(self, script: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["docker", "exec", "--interactive", self._id, "bash", "-eu"],
            input=script,
            capture_output=True,
            text=True,
            check=False,
        )

    def say(self, script: str) -> str:
        """What a script says, which has to work."""
        done = self.run(script)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def stand_in_for_ssh(self, folder: Path) -> None:
        """Write a program `ssh` that runs the command in the machine, as root, whatever its host."""
        program = folder / "ssh"
        program.write_text(f'#!/bin/sh\nexec docker exec --interactive {self._id} sh -c "$3"\n')
        program.chmod(0o755)

    def put(self, path: Path, target: str) -> None:
        """Copy a file into it, not below ``/run`` or ``/tmp``."""
        _call("docker", "cp", str(path), f"{self._id}:{target}")

    @property
    def pid(self) -> int:
        """Of its first process, as this machine counts."""
        return int(_call("docker", "inspect", "--format", "{{.State.Pid}}", self._id))

    def add_address(self, address: str) -> None:
        """Give its loopback interface an address, from outside."""
        _call("nsenter", f"--target={self.pid}", "--net", "ip", "address", "add", address, "dev", "lo")

    def facts(self, unit: str) -> dict[str, str]:
        """All properties of a unit, as they were at one moment."""
        lines = self.say(f"systemctl show --all {unit}").splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def show(self, unit: str, key: str) -> str:
        """A property of a unit."""
        return self.facts(unit)[key]

    def until(self, condition: Callable[[], bool]) -> float:
        """Wait for a condition; how many seconds that took. Raises TimeoutError if it does not hold in time."""
        began = time.monotonic()
        while not condition():
            if time.monotonic() >= began + PATIENCE_S:
                raise TimeoutError
            time.sleep(0.05)
        return time.monotonic() - began


def _call(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stdout, done.stderr)
    done.check_returncode()
    return done.stdout
