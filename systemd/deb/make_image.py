"""Build the container image from the checkout, with wheels that are downloaded outside of it.

``configs/containers/README.md`` says how compose builds it, with packages from the index. This is for a release, and
for engines whose containers do not reach the index.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from make_deb import run
from wheels import BACKEND_LOCK, HASHED, IMAGE_LOCK, MACHINES, PROJECT, RELEASES, pip

DOCKERFILE = PROJECT / "configs/containers/Dockerfile"
CONTEXT = (".dockerignore", "LICENSE", "README.md", "configs", "pyproject.toml", "systemd", "uavlinkd")


def main() -> int:
    """Build one image."""
    parser = argparse.ArgumentParser(description="Build the container image of uavlinkd.")
    parser.add_argument("--base", default="debian:bookworm-slim", metavar="IMAGE", help="(default: %(default)s)")
    parser.add_argument("--tag", default="uavlinkd", metavar="NAME", help="(default: %(default)s)")
    parser.add_argument("--architecture", choices=sorted(MACHINES), default="amd64", help="(default: %(default)s)")
    options = parser.parse_args()
    build(options.base, options.tag, options.architecture)
    return 0


def build(base: str, tag: str, architecture: str) -> None:
    """Build the image in a copy of what it needs of the checkout, which is left as it is."""
    with tempfile.TemporaryDirectory(prefix="uavlinkd-image-") as name:
        context = Path(name)
        for path in (PROJECT / part for part in CONTEXT):
            copy = shutil.copytree if path.is_dir() else shutil.copy
            copy(path, context / path.name)
        for lock in (BACKEND_LOCK, IMAGE_LOCK):
            selection = RELEASES[12].selection(MACHINES[architecture])
            pip("download", *HASHED, *selection, f"--dest={context / 'wheels'}", "--requirement", lock)
        offline = ("PIP_NO_INDEX=1", "PIP_FIND_LINKS=/packages", f"BASE={base}")
        arguments = (argument for value in offline for argument in ("--build-arg", value))
        platform = f"--platform=linux/{architecture}"
        run("docker", "build", "--quiet", platform, *arguments, "--file", DOCKERFILE, "--tag", tag, context)


if __name__ == "__main__":
    sys.exit(main())
