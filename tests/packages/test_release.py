"""What ``systemd/deb/release.py`` adds to the packages: bills of materials, and the labels of the image."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from uavlinkd import __version__

ROOT = Path(__file__).parents[2]
DEB = ROOT / "systemd/deb"
DOCKERFILE = ROOT / "configs/containers/Dockerfile"
LABELS = dict(re.findall(r"""^(?:LABEL |    )(\w+)=["'](.*?)["'](?: \\)?$""", DOCKERFILE.read_text(), re.MULTILINE))


@pytest.mark.parametrize(
    ("lock", "extras"), [("debian-12", "speed web"), ("debian-13", "speed web"), ("image", "lab speed web")]
)
def test_lock_file_has_every_dependency(lock: str, extras: str) -> None:
    """A new dependency of the project needs new lock files: `python systemd/deb/wheels.py` writes them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    added = (one for extra in extras.split() for one in project["optional-dependencies"][extra])
    names = {re.split(r"[^\w.-]", one)[0].replace("_", "-") for one in (*project["dependencies"], *added)}
    locked = set(re.findall(r"^(\S+)==", (DEB / f"{lock}.lock").read_text(), re.MULTILINE))
    assert names - {"uavlinkd"} <= locked


@pytest.mark.long
def test_bill_of_materials_has_what_is_locked(tmp_path: Path) -> None:
    """Each package of a lock file with its version and all of its hashes, and nothing of this machine."""
    lock, bill = DEB / "debian-12.lock", tmp_path / "bill.json"
    script = "import sys, pathlib, release; release.write_bill(*map(pathlib.Path, sys.argv[1:]))"
    subprocess.run([sys.executable, "-c", script, lock, bill, tmp_path], cwd=DEB, check=True)

    written = json.loads(bill.read_text())

    described = written["metadata"]["component"]
    assert (written["bomFormat"], described["name"], described["version"]) == ("CycloneDX", "uavlinkd", __version__)
    locked = dict(re.findall(r"^(\S+==\S+)((?: \\\n    --hash=sha256:\S+)+)", lock.read_text(), re.MULTILINE))
    assert {f"{one['name']}=={one['version']}": hashes(one) for one in written["components"]} == {
        pin: set(re.findall(r"sha256:(\S+)", text)) for pin, text in locked.items()
    }
    assert str(tmp_path) not in bill.read_text()
    assert str(ROOT) not in bill.read_text()


def hashes(component: dict[str, list[dict[str, list[dict[str, str]]]]]) -> set[str]:
    """The hashes of a component's files."""
    return {one["content"] for reference in component["externalReferences"] for one in reference["hashes"]}


def test_image_has_the_labels_of_blueos() -> None:
    """Its version is the project's, and what BlueOS parses as JSON is JSON: permissions that give no capability."""
    assert LABELS["version"] == __version__
    assert LABELS["type"] in {"device-integration", "example", "theme", "other", "tool", "education"}
    assert all(re.fullmatch("[a-z0-9-]+", tag) for tag in json.loads(LABELS["tags"]))
    assert {"name", "email"} <= json.loads(LABELS["company"]).keys()
    assert [author.keys() >= {"name", "email"} for author in json.loads(LABELS["authors"])] == [True]
    permissions = json.loads(LABELS["permissions"])
    assert permissions["HostConfig"]["CapDrop"] == ["ALL"]
    assert "Privileged" not in permissions["HostConfig"]
