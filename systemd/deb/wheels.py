"""The Debian releases, their Pythons, and the wheels of their packages.

``python3 systemd/deb/wheels.py`` writes the lock files again, with the latest versions that pyproject.toml allows.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
BACKEND_LOCK = HERE / "backend.lock"
"""What builds the wheel of uavlinkd, and its shell completions."""
SBOM_LOCK = HERE / "sbom.lock"
"""What writes the bill of materials of a release."""
IMAGE_LOCK = HERE / "image.lock"
"""What the container image has: the laboratory and the page, on the Python of Debian 12."""
SBOM = (
    *("boolean.py", "chardet", "cyclonedx-bom>=7.5,<8", "cyclonedx-python-lib", "defusedxml", "license-expression"),
    *("packageurl-python", "packaging", "pip-requirements-parser", "py-serializable", "pyparsing"),
    *("sortedcontainers", "typing-extensions"),
)
"""The tool for the bill of materials with what it needs to run, but for what only its checks need."""
HASHED = ("--require-hashes", "--no-deps", "--only-binary=:all:")
"""The options of pip that install what a lock file has, and no more."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""Debian's names of architectures, and those in the names of wheels."""


@dataclass(frozen=True, slots=True)
class Release:
    """One release of Debian."""

    number: int
    codename: str
    python: str
    glibc: int
    """The minor version of glibc 2, which limits the wheels that run there."""

    @property
    def lock(self) -> Path:
        """The versions and hashes of its wheels."""
        return HERE / f"debian-{self.number}.lock"

    @property
    def next_python(self) -> str:
        """The first version of Python for which the wheels do not fit."""
        major, minor = self.python.split(".")
        return f"{major}.{int(minor) + 1}"

    def selection(self, machine: str) -> list[str]:
        """The options of pip that select wheels for this release."""
        platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(5, self.glibc + 1)]
        platforms += [f"{name}_{machine}" for name in ("manylinux1", "manylinux2010", "manylinux2014")]
        return [
            *("--only-binary=:all:", "--implementation=cp", f"--python-version={self.python}"),
            *(f"--platform={platform}" for platform in platforms),
        ]


RELEASES = {
    release.number: release for release in (Release(12, "bookworm", "3.11", 36), Release(13, "trixie", "3.13", 41))
}


def pip(*arguments: str | Path) -> None:
    """Run this Python's pip, which must succeed."""
    subprocess.run([sys.executable, "-m", "pip", *arguments, "--quiet", "--disable-pip-version-check"], check=True)


def download(release: Release, machine: str, folder: Path) -> None:
    """Download the wheels of a release's lock file for one kind of machine."""
    pip("download", *HASHED, *release.selection(machine), f"--dest={folder}", "--requirement", release.lock)


def install_tools(lock: Path, folder: Path) -> None:
    """Install tools of the build into a folder, for this Python."""
    pip("install", *HASHED, f"--target={folder}", "--no-compile", "--requirement", lock)


def requirements(*extras: str) -> list[str]:
    """What a daemon needs, and what some extras of the project add to it."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    added = (one for extra in extras for one in project["optional-dependencies"][extra])
    return [*project["dependencies"], *(one for one in added if not one.startswith(project["name"]))]


def name_of(requirement: str) -> str:
    """The name of the distribution that a requirement begins with."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement)[0]).lower()


def write_lock(path: Path, text: str, *folders: Path) -> None:
    """Write a file of requirements: the wheels in some folders, with their hashes."""
    hashes = defaultdict[str, set[str]](set)
    for wheel in (wheel for folder in folders for wheel in folder.iterdir()):
        name, version, *_ = wheel.name.split("-")
        hashes[f"{name_of(name)}=={version}"].add(hashlib.sha256(wheel.read_bytes()).hexdigest())
    lines = [f"# {text} Written by wheels.py."]
    for pin in sorted(hashes):
        lines += [" \\\n".join([pin, *(f"    --hash=sha256:{value}" for value in sorted(hashes[pin]))])]
    path.write_text("\n".join(lines) + "\n")


def main() -> None:
    """Write all lock files."""
    file = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    backend = [*file["build-system"]["requires"], *file["project"]["optional-dependencies"]["completion"]]
    with tempfile.TemporaryDirectory(prefix="uavlinkd-wheels-") as name:
        folder = Path(name)
        pip("download", "--only-binary=:all:", f"--dest={folder / 'backend'}", *backend)
        write_lock(BACKEND_LOCK, "What builds the wheel of uavlinkd, and its shell completions.", folder / "backend")
        pure = ("--no-deps", "--only-binary=:all:", "--platform=any", "--abi=none", "--implementation=py")
        pip("download", *pure, f"--dest={folder / 'sbom'}", *SBOM)
        write_lock(SBOM_LOCK, "What writes the bill of materials of a release.", folder / "sbom")
        for release in RELEASES.values():
            lock(release.lock, release, folder / str(release.number), requirements("speed", "web"))
        lock(IMAGE_LOCK, RELEASES[12], folder / "image", requirements("lab", "speed", "web"))


def lock(path: Path, release: Release, folder: Path, wanted: list[str]) -> None:
    """Write one lock file: the wheels for all kinds of machines with the Python of a release."""
    folders = [folder / machine for machine in MACHINES.values()]
    for machine, wheels in zip(MACHINES.values(), folders, strict=True):
        pip("download", f"--dest={wheels}", *release.selection(machine), *wanted)
    machines = " and ".join(MACHINES.values())
    write_lock(path, f"Debian {release.number}: wheels for Python {release.python} on {machines}.", *folders)


if __name__ == "__main__":
    main()
