"""The files in configs/, and those on the pages, are valid."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config
from uavlinkd.config.schema import POLICY, SECTIONS
from uavlinkd.config.section import REQUIRED, read
from uavlinkd.mavlink.policy.roles import ROLES

EXAMPLES = Path(__file__).parents[2] / "configs"
STATION = (EXAMPLES / "ground-station.toml").read_text()
_OTHERS = {"mitm"}  # configurations of other commands, with tests of their own
_PAGES = ("uavlinkd/config/README.md",)
_BLOCKS = [
    re.findall(r"^```toml\n(.*?)^```", (EXAMPLES.parent / page).read_text(), re.DOTALL | re.MULTILINE)
    for page in _PAGES
]
assert all(_BLOCKS), "a page has no configuration"


def loaded(folder: Path, text: str) -> Config:
    """The configuration beside the key files that it names, which has no warning."""
    table = tomllib.loads(text)
    keys.write_secret_file(folder / table["private_key_file"], keys.generate_private_key())
    for peer in table.get("peer", []):
        if "psk_file" in peer:
            keys.write_secret_file(folder / peer["psk_file"], keys.generate_psk())
    path = folder / "example.toml"
    path.write_text(text)
    config = load_config(path, {})
    assert config.warnings == ()
    return config


@pytest.mark.parametrize(
    "path", sorted(path for path in EXAMPLES.glob("*.toml") if path.stem not in _OTHERS), ids=lambda path: path.stem
)
def test_example_is_valid(tmp_path: Path, path: Path) -> None:
    """Each file in configs/ loads without a warning."""
    config = loaded(tmp_path, path.read_text())
    assert config.is_only_relay or (config.peers and config.endpoints)


@pytest.mark.parametrize("text", [text for texts in _BLOCKS for text in texts])
def test_configuration_in_a_readme_is_valid(tmp_path: Path, text: str) -> None:
    """The loader accepts it as it is."""
    config = loaded(tmp_path, text)
    assert config.peers
    assert config.endpoints


def test_station_has_every_default() -> None:
    """The ground station's file contains every key with its default, and names each key of a policy."""
    table = tomllib.loads(STATION)
    for name in ("link", "routing"):
        values, problems = read(SECTIONS[name], table[name])
        assert (values.valid, problems) == ({key: one.default for key, one in SECTIONS[name].items()}, [])
    (endpoint,) = table["endpoint"]
    keys = SECTIONS["endpoint"]
    values, problems = read(keys, endpoint)
    of_autopilots = {"signing_key_file", "signing_link_id"}
    assert (set(endpoint), problems) == (set(keys) - set(POLICY) - of_autopilots, [])
    assert all(keys[key].default in (REQUIRED, value) for key, value in values.valid.items())
    assert {*POLICY, *ROLES} <= set(re.findall(r"[\w-]+", STATION))


def test_examples_fit_together() -> None:
    """A peer with the name drone1 has one key in all files. No private key is kept: it would serve an attacker."""
    keys_by_peer: dict[str, set[str]] = {}
    for path in EXAMPLES.glob("*.toml"):
        for peer in tomllib.loads(path.read_text()).get("peer", []):
            keys_by_peer.setdefault(peer["name"], set()).add(peer["public_key"])
    assert {"drone0", "drone1"} <= set(keys_by_peer)
    assert all(len(known) == 1 for known in keys_by_peer.values())
    assert [path.name for path in EXAMPLES.iterdir() if path.suffix in (".key", ".psk")] == []
