"""Keys in the wrong place are recognised, and no message repeats one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.config.files import GOOD, KEY, OTHER_PEER, load, member, refused, relay
from uavlinkd.config import keys
from uavlinkd.config.key_rules import EXAMPLE_KEYS

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


def test_keys_of_the_examples_are_known() -> None:
    """Each public key in README.md, the packages' pages and configs/ is in the list, and no other."""
    pages = [ROOT / "README.md", *(ROOT / "configs").rglob("*.*"), *(ROOT / "uavlinkd").rglob("*.md")]
    shown = {key for page in pages for key in _SHOWN.findall(page.read_text(errors="replace"))}
    assert shown == EXAMPLE_KEYS


@pytest.mark.parametrize("what", ["peer", "relay", "member"])
def test_suspicious_key_is_warned_of(tmp_path: Path, what: str) -> None:
    """A reader copied an example's key with its file; or the key has the form of a private one, as some of ``wg``."""
    private = keys.generate_private_key()
    for key, words in ((min(EXAMPLE_KEYS), "is the key of an example"), (private, "has the form of a private key")):
        text = {
            "peer": OTHER_PEER.replace(KEY["b"], key),
            "relay": "confidential = true\n" + relay(key=key),
            "member": member("b", key),
        }[what]
        warnings = load(tmp_path, GOOD + text).warnings
        (warning,) = (warning for warning in warnings if "public_key" in warning)
        assert re.match(rf'{what} "\w+": public_key {words}.*on the {what}', warning)
        assert private[:8] not in warning
