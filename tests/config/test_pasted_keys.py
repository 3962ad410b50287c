"""Keys in the wrong place are recognised, and no message repeats one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.config.files import GOOD, KEY, OTHER_PEER, load, member, refused, relay
from uavlinkd.config import keys

ROOT = Path(__file__).parents[2]
_SHOWN = re.compile(r"(?<![A-Za-z0-9+/])[A-Za-z0-9+/]{43}=")


def _problem(folder: Path, secret: str) -> str:
    """The problem of a file with a secret key in place of the peer's public key."""
    ((place, message),) = refused(folder, GOOD.replace(KEY["drone1"], secret)).items()
    assert place == "peer[0].public_key (drone1)"
    assert secret[:8] not in message
    return message


def test_own_private_key(tmp_path: Path) -> None:
    """The remedy is a new key."""
    load(tmp_path, GOOD)
    message = _problem(tmp_path, (tmp_path / "drone0.key").read_text().strip())
    assert message.startswith("is this daemon's private key")
    assert "make a new one with `uavlinkd keygen`" in message


def test_public_key_in_the_private_key_file(tmp_path: Path) -> None:
    """The peer's own key in the file of the private key: no secret is exposed."""
    load(tmp_path, GOOD)
    (tmp_path / "drone0.key").write_text(KEY["drone1"])
    assert "holds the public key of peer[0] (drone1)" in refused(tmp_path, GOOD)["private_key_file"]
    (tmp_path / "drone0.key").write_text(KEY["c"])
    (warning,) = load(tmp_path, GOOD).warnings
    assert "private_key_file holds a key without the form of a private key" in warning


def test_no_example_shows_a_private_key() -> None:
    """A person may copy each key in README.md, the packages' pages and configs/ into a file."""
    pages = [ROOT / "README.md", *(ROOT / "configs").rglob("*.*"), *(ROOT / "uavlinkd").rglob("*.md")]
    shown = {key for page in pages for key in _SHOWN.findall(page.read_text(errors="replace"))}
    assert not any(keys.looks_private(keys.decode_key(key)) for key in shown)


@pytest.mark.parametrize("what", ["peer", "relay", "member"])
def test_suspicious_key_is_warned_of(tmp_path: Path, what: str) -> None:
    """A public key that has the form of a private one, as some of ``wg``."""
    private = keys.generate_private_key()
    text = {
        "peer": OTHER_PEER.replace(KEY["b"], private),
        "relay": "confidential = true\n" + relay(key=private),
        "member": member("b", private),
    }[what]
    warnings = load(tmp_path, GOOD + text).warnings
    (warning,) = (warning for warning in warnings if "public_key" in warning)
    assert re.match(rf'{what} "\w+": public_key has the form of a private key.*key of that {what}', warning)
    assert private[:8] not in warning
