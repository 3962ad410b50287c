"""Build the Debian package of one release. ``systemd/README.md`` says how to use it.

Wheels are downloaded outside, with the hashes of a lock file. The environment is made inside a root of that release,
where no command uses the network, also the environment of another architecture: its wheels are only unpacked. Two
builds of the same source are equal byte for byte.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from wheels import BACKEND_LOCK, HERE, MACHINES, PROJECT, RELEASES, Release, download, install_tools

PLACE = "opt/uavlinkd"
SCRIPTS = ("preinst", "postinst", "prerm", "postrm")
_WORK = "uavlinkd-package"
"""The folder inside the root for wheels and package."""

CONTROL = """\
Package: uavlinkd
Version: {version}
Architecture: {architecture}
Maintainer: The uavlinkd authors
Installed-Size: {size}
Depends: python3 (>= {python}), python3 (<< {next_python})
Recommends: systemd (>= 250)
Section: net
Priority: optional
Description: authenticated MAVLink link between drones
 A daemon that carries MAVLink between vehicles and ground stations over UDP, in
 authenticated envelopes. An attacker on the network cannot forge, alter, replay
 or redirect a frame.
 .
 The laboratory (sim, demo, evaluate and uavlink-mitm) is not in this package.
"""


def main() -> int:
    """Build one package and print its path, size and hash."""
    parser = argparse.ArgumentParser(description="Build the Debian package of uavlinkd for one release.")
    parser.add_argument("--release", type=int, choices=sorted(RELEASES), required=True)
    parser.add_argument("--architecture", choices=sorted(MACHINES), help="of the package (default: the root's)")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="where to write it (default: here)")
    parser.add_argument(
        "--root", type=Path, metavar="DIR", help="a root of that release with python3-venv, to build in"
    )
    parser.add_argument("--mirror", metavar="URL", help="Debian mirror for debootstrap")
    parser.add_argument("--revision", type=int, default=1, metavar="N", help="of the package (default: %(default)s)")
    options = parser.parse_args()
    problem = prepare(needs_debootstrap=options.root is None)
    if problem is not None:
        return fail(problem)
    try:
        with tempfile.TemporaryDirectory(prefix="uavlinkd-deb-") as name:
            release = RELEASES[options.release]
            if options.root is None:
                options.root = Path(name, "root")
                make_root(release, options.root, options.mirror)
            package = build(release, options, Path(name))
    except subprocess.CalledProcessError as error:
        return fail(f"{error.cmd[0]} failed with exit status {error.returncode}")
    content = package.read_bytes()
    print(f"{package}  {len(content):,} bytes  SHA-256 {hashlib.sha256(content).hexdigest()}")
    return 0


def prepare(*, needs_debootstrap: bool) -> str | None:
    """Set what makes builds equal, the mask and SOURCE_DATE_EPOCH; or the reason why nothing can be built here."""
    if os.geteuid():
        return "must run as root, which debootstrap and chroot need: use sudo"
    if needs_debootstrap and shutil.which("debootstrap") is None:
        return "debootstrap is not installed: sudo apt install debootstrap"
    try:
        epoch = os.environ.get("SOURCE_DATE_EPOCH") or output("git", "-C", PROJECT, "log", "-1", "--format=%ct")
    except (OSError, subprocess.CalledProcessError):
        return "this is not a Git checkout: set SOURCE_DATE_EPOCH to the time of the source, in seconds"
    os.umask(0o022)
    os.environ["SOURCE_DATE_EPOCH"] = epoch
    return None


def version() -> str:
    """The version of the project."""
    return str(tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["version"])


def make_root(release: Release, root: Path, mirror: str | None) -> None:
    """Make a root to build in."""
    packages = "--include=python3,python3-venv"
    run("debootstrap", "--variant=minbase", packages, release.codename, root, *([mirror] if mirror else []))


def build(release: Release, options: argparse.Namespace, folder: Path) -> Path:
    """Build the package with ``--root``, in a folder of its own. Its path in ``--out``."""
    root = options.root
    native = output("chroot", root, "dpkg", "--print-architecture")
    architecture = options.architecture or native
    build_wheel(folder)
    for name in {native, architecture}:
        download(release, MACHINES[name], folder / "wheels")
    full_version = f"{version()}-{options.revision}+deb{release.number}"
    with working_folder(root) as work:
        shutil.copytree(folder / "wheels", work / "wheels")
        shutil.copy(release.lock, work / "lock")
        install(root)
        tree = work / "tree"
        # Beside shtab, which the script imports from its own folder.
        shutil.copytree(folder / "backend/shtab", work / "manuals/shtab")
        shutil.copy(HERE / "manuals.py", work / "manuals")
        inside(root, f"/{PLACE}/bin/python3", f"/{_WORK}/manuals/manuals.py", f"/{_WORK}/tree/usr")
        if architecture != native:
            install(root, release.selection(MACHINES[architecture]))
        lay_out(root, tree)
        control = CONTROL.format(
            version=full_version,
            architecture=architecture,
            size=sum(-(-path.lstat().st_size // 1024) or 1 for path in tree.rglob("*")),
            python=release.python,
            next_python=release.next_python,
        )
        (tree / "DEBIAN").mkdir()
        (tree / "DEBIAN/control").write_text(control)
        for script in SCRIPTS:
            shutil.copy(HERE / script, tree / "DEBIAN")
        settle(tree, int(os.environ["SOURCE_DATE_EPOCH"]))
        # This release's dpkg-deb, and one thread: others write other bytes.
        # Level 6 would save 2 MB and take five times as long.
        compress = ("-Zxz", "-z1", "--threads-max=1", "--root-owner-group")
        inside(root, "dpkg-deb", *compress, "--build", f"/{_WORK}/tree", f"/{_WORK}/uavlinkd.deb")
        options.out.mkdir(parents=True, exist_ok=True)
        package = Path(options.out, f"uavlinkd_{full_version}_{architecture}.deb")
        shutil.copyfile(work / "uavlinkd.deb", package)
    return package


def build_wheel(folder: Path, kind: str = "wheel") -> None:
    """Build the wheel of uavlinkd into ``wheels``, or its source distribution; ``backend`` has the tools then."""
    if not (folder / "backend").exists():
        install_tools(BACKEND_LOCK, folder / "backend")
    build = f"import hatchling.build, sys; hatchling.build.build_{kind}(sys.argv[1])"
    environ = {**os.environ, "PYTHONPATH": str(folder / "backend"), "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run([sys.executable, "-c", build, folder / "wheels"], cwd=PROJECT, env=environ, check=True)


@contextmanager
def working_folder(root: Path) -> Iterator[Path]:
    """A folder in the root, which is left as it was."""
    leftovers = (root / _WORK, root / PLACE)
    for path in leftovers:
        shutil.rmtree(path, ignore_errors=True)
    (root / _WORK).mkdir()
    try:
        yield root / _WORK
    finally:
        for path in leftovers:
            shutil.rmtree(path, ignore_errors=True)


def install(root: Path, selection: Sequence[str] = ()) -> None:
    """Make the environment in the root, without pip and with bytecode.

    The daemon cannot write bytecode at run time. Bytecode with a hash instead of a time is equal in each build.
    ``selection`` has pip's options for a machine that is not the root's: its modules in C cannot run here.
    """
    shutil.rmtree(root / PLACE, ignore_errors=True)
    python = f"/{PLACE}/bin/python3"
    inside(root, "python3", "-m", "venv", "--without-pip", f"/{PLACE}")
    (packages,) = (root / PLACE).glob("lib/python3.*/site-packages")
    wheel = next((root / "usr/share/python-wheels").glob("pip-*.whl")).relative_to(root)
    local = ("install", "--quiet", "--no-index", "--no-deps", "--no-compile", f"--find-links=/{_WORK}/wheels")
    other = (*selection, f"--target=/{packages.relative_to(root)}") if selection else ()
    inside(root, python, f"/{wheel}/pip", *local, *other, "--require-hashes", "--requirement", f"/{_WORK}/lock")
    shutil.rmtree(packages / "bin", ignore_errors=True)  # commands of dependencies, which ``--target`` puts there
    inside(root, python, f"/{wheel}/pip", *local, "uavlinkd")
    if not selection:
        inside(root, python, f"/{wheel}/pip", "check")
    shutil.rmtree(packages / "uavlinkd/lab")
    inside(root, python, "-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash", f"/{PLACE}/lib")


def lay_out(root: Path, tree: Path) -> None:
    """Copy what the package installs to where it installs it, below ``tree``."""
    shutil.copytree(root / PLACE, tree / PLACE, symlinks=True)
    (tree / "usr/bin").mkdir(parents=True)
    (tree / "usr/bin/uavlinkd").symlink_to(f"/{PLACE}/bin/uavlinkd")
    (tree / "etc/uavlinkd/keys").mkdir(parents=True)
    units, documents = tree / "usr/lib/systemd/system", tree / "usr/share/doc/uavlinkd"
    units.mkdir(parents=True)
    for unit in (PROJECT / "systemd").glob("uavlinkd*.service"):
        shutil.copyfile(unit, units / unit.name)
    shutil.copytree(PROJECT / "configs", documents / "examples")
    shutil.copyfile(PROJECT / "CHANGELOG.md", documents / "CHANGELOG.md")
    shutil.copyfile(PROJECT / "LICENSE", documents / "copyright")


def settle(tree: Path, epoch: int) -> None:
    """Give each file its mode and the source's time."""
    for path in [tree, *tree.rglob("*")]:
        if not path.is_symlink():
            is_open = path.is_dir() or path.parent.name == "bin" or path.name in SCRIPTS
            path.chmod(0o755 if is_open else 0o644)
        os.utime(path, (epoch, epoch), follow_symlinks=False)
    (tree / "etc/uavlinkd/keys").chmod(0o700)


def run(*command: str | Path) -> None:
    """Run a command that must succeed; print its output only if it fails."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        print(done.stdout, file=sys.stderr)
    done.check_returncode()


def inside(root: Path, *command: str) -> str:
    """The output of a command in the root, in the same environment on every machine."""
    environ = {name: value for name, value in os.environ.items() if name == "SOURCE_DATE_EPOCH"}
    environ |= {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8", "PYTHONHASHSEED": "0", "HOME": "/root"}
    environ |= {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_CACHE_DIR": "1", "PIP_ROOT_USER_ACTION": "ignore"}
    done = subprocess.run(
        ["chroot", str(root), *command], env=environ, stdout=subprocess.PIPE, text=True, check=False, umask=0o022
    )
    if done.returncode:
        print(done.stdout, file=sys.stderr)
    done.check_returncode()
    return done.stdout


def output(*command: str | Path) -> str:
    """The output of a command that must succeed."""
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def fail(problem: str) -> int:
    """Print a problem; the exit status."""
    print(f"make_deb.py: {problem}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
