"""The signing keys of endpoints: which files they come from, and which are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.config.files import ENDPOINT, GCS, GOOD, HEAD, PEER, load, refused
from uavlinkd.config import keys
from uavlinkd.config.changes import compare
from uavlinkd.config.model import ConfigError, SigningConfig
from uavlinkd.protocol.crypto import Secret

LINE = 'signing_key_file = "autopilot.key"\n'
SIGNED = HEAD + ENDPOINT + LINE + PEER
_AT = "endpoint[0].signing_key_file (autopilot)"


def _write(folder: Path, name: str, byte: int) -> Secret:
    keys.write_secret_file(folder / name, keys.encode_key(bytes((byte,)) * 32))
    return Secret(bytes((byte,)) * 32)


def test_key_and_link_id(tmp_path: Path) -> None:
    """The file of a change that goes on is the command's alone."""
    key = _write(tmp_path, "autopilot.key", 1)
    _write(tmp_path, "autopilot.key.new", 2)
    assert load(tmp_path, SIGNED).endpoints[0].signing == SigningConfig(key)
    text = SIGNED.replace(LINE, LINE + "signing_link_id = 77\n")
    assert load(tmp_path, text).endpoints[0].signing == SigningConfig(key, 77)
    assert load(tmp_path, GOOD).endpoints[0].signing is None


def test_file_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    """Another length, another mode, none: the message names the file and what to do."""
    assert "`uavlinkd signing setup` beside an autopilot without a key" in refused(tmp_path, SIGNED)[_AT]
    path = tmp_path / "autopilot.key"
    _write(tmp_path, path.name, 1)
    path.chmod(0o640)
    assert "run `chmod 600" in refused(tmp_path, SIGNED)[_AT]
    path.chmod(0o600)
    path.write_text("AAAA\n")
    assert "is not a key" in refused(tmp_path, SIGNED)[_AT]


def test_link_id_has_one_endpoint(tmp_path: Path) -> None:
    """Two with the same key would reject each other's timestamps at the autopilot."""
    _write(tmp_path, "autopilot.key", 1)
    two = HEAD + ENDPOINT + LINE + GCS.replace("14550", "14551") + LINE
    place = "endpoint[1].signing_link_id (gcs)"
    assert "in use by endpoint[0] (autopilot)" in refused(tmp_path, two + PEER)[place]
    assert len(load(tmp_path, two + "signing_link_id = 22\n" + PEER).endpoints) == 2


@pytest.mark.parametrize(("name", "lines"), [("drone0.key", ""), ("pair.psk", 'psk_file = "pair.psk"\n')])
def test_key_of_another_protocol_is_refused(tmp_path: Path, name: str, lines: str) -> None:
    """SETUP_SIGNING would carry it over the cable in clear."""
    assert "another key of this file" in refused(tmp_path, SIGNED.replace("autopilot.key", name) + lines)[_AT]


def test_signing_needs_a_restart(tmp_path: Path) -> None:
    """A reload keeps an endpoint's keys and link id."""
    _write(tmp_path, "autopilot.key", 1)
    before = load(tmp_path, SIGNED)
    for text in (GOOD, SIGNED.replace(LINE, LINE + "signing_link_id = 22\n")):
        with pytest.raises(ConfigError, match=r"endpoint: has changed.*restart"):
            compare(before, load(tmp_path, text))
