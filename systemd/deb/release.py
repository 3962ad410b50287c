"""Build a release: all that users download, bills of materials, and checksums. ``systemd/README.md`` has the command.

Without a Docker engine, or the image's base, a warning says that the image is left out. All other files are equal in
each build of a commit, byte for byte, if Debian's packages are the same.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import make_deb
import make_image
from wheels import IMAGE_LOCK, MACHINES, PROJECT, RELEASES, SBOM_LOCK, install_tools


def main() -> int:
    """Build everything into one folder, and print what is there."""
    parser = argparse.ArgumentParser(description="Build a release of uavlinkd.")
    parser.add_argument("--out", type=Path, default=Path("release"), metavar="DIR", help="(default: %(default)s)")
    parser.add_argument("--base", default="debian:bookworm-slim", metavar="IMAGE", help="(default: %(default)s)")
    parser.add_argument("--mirror", metavar="URL", help="Debian mirror for debootstrap")
    options = parser.parse_args()
    problem = make_deb.prepare(needs_debootstrap=True)
    if problem is not None:
        return make_deb.fail(problem)
    options.out.mkdir(parents=True, exist_ok=True)
    if any(options.out.iterdir()):
        return make_deb.fail(f"{options.out} is not empty: a release has no other files. Name another folder")
    try:
        with tempfile.TemporaryDirectory(prefix="uavlinkd-release-") as name:
            build(options, Path(name))
    except subprocess.CalledProcessError as error:
        return make_deb.fail(f"{error.cmd[0]} failed with exit status {error.returncode}")
    print((options.out / "SHA256SUMS").read_text(), end="")
    return 0


def build(options: argparse.Namespace, folder: Path) -> None:
    """Build the files of the release into ``--out``."""
    out: Path = options.out
    for kind in ("sdist", "wheel"):
        make_deb.build_wheel(folder, kind)
    for file in (folder / "wheels").iterdir():
        shutil.copyfile(file, out / file.name)
    for release in RELEASES.values():
        root = folder / f"root-{release.number}"
        make_deb.make_root(release, root, options.mirror)
        for architecture in MACHINES:
            package = argparse.Namespace(root=root, architecture=architecture, out=out, revision=1)
            make_deb.build(release, package, folder / f"{release.number}-{architecture}")
        write_bill(release.lock, out / f"uavlinkd-{make_deb.version()}-debian{release.number}.cdx.json", folder)
        shutil.rmtree(root)
    if save_image(options.base, out / f"uavlinkd-{make_deb.version()}-image.tar.gz"):
        write_bill(IMAGE_LOCK, out / f"uavlinkd-{make_deb.version()}-image.cdx.json", folder)
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(out.iterdir())]
    (out / "SHA256SUMS").write_text("".join(sums))


def write_bill(lock: Path, path: Path, folder: Path) -> None:
    """Write the bill of materials of a lock file, in CycloneDX's JSON."""
    tools = folder / "sbom"
    if not tools.exists():
        install_tools(SBOM_LOCK, tools)
    environ = {**os.environ, "PYTHONPATH": str(tools), "PYTHONWARNINGS": "ignore"}
    # Its checks need packages in C. The tests compare the result with the lock file.
    command = [sys.executable, "-m", "cyclonedx_py", "requirements", "--no-validate", "--output-reproducible"]
    described = ("--pyproject", PROJECT / "pyproject.toml", "--output-file", path, lock)
    subprocess.run([*command, *described], env=environ, stderr=subprocess.DEVNULL, check=True)


def save_image(base: str, path: Path) -> bool:
    """Build and save the container image of this machine's architecture, if that is possible; whether it was."""
    if shutil.which("docker") is None or not succeeds("docker", "info"):
        print("release.py: no image: no Docker engine answers", file=sys.stderr)
        return False
    if not succeeds("docker", "image", "inspect", base) and not succeeds("docker", "pull", base):
        print(f"release.py: no image: the Docker engine cannot get {base}; --base names another one", file=sys.stderr)
        return False
    name = f"uavlinkd:{make_deb.version()}"
    make_image.build(base, name, make_deb.output("dpkg", "--print-architecture"))
    with subprocess.Popen(["docker", "save", name], stdout=subprocess.PIPE) as save:
        assert save.stdout is not None
        with gzip.GzipFile(path, "wb", mtime=0) as file:
            shutil.copyfileobj(save.stdout, file)
    if save.returncode:
        raise subprocess.CalledProcessError(save.returncode, save.args)
    return True


def succeeds(*command: str) -> bool:
    """Whether a command succeeds."""
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


if __name__ == "__main__":
    sys.exit(main())
