"""Keys in the wrong place are recognised, and no message repeats one."""

from __future__ import annotations

import base64
import re
import secrets
from collections.abc import Callable
from pathlib import Path

import pytest

from uavlinkd.config import Config, ConfigError, keys
from uavlinkd.config.load import load_config
from uavlinkd.config.pasted_keys import EXAMPLE_KEYS

ROOT = Path(__file__).parents[2]
Load = Callable[[str], Config]
_KEY = re.compile(r"[A-Za-z0-9+/]{43}=")


def _config(public_key: str, more: str = "") -> str:
    return (
        'name = "drone0"\nprivate_key_file = "drone0.key"\nlisten = ["0.0.0.0:5790"]\n'
        '[[endpoint]]\nname = "autopilot"\nurl = "udpin:127.0.0.1:14550"\n'
        f'[[peer]]\nname = "drone1"\npublic_key = "{public_key}"\nrole = "swarm-member"\nsystem_ids = [2]\n{more}'
    )


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Loads a text as a file beside a private key and a PSK."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    keys.write_secret_file(tmp_path / "pair.psk", keys.generate_psk())

    def loading(text: str) -> Config:
        path = tmp_path / "drone0.toml"
        path.write_text(text)
        return load_config(path, {})

    return loading


def _problem(load: Load, text: str, secret: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(text)
    (problem,) = caught.value.problems
    assert secret not in repr(caught.value)
    assert secret[:8] not in str(caught.value)
    return str(problem)


def test_private_keys_are_distinguished_from_public_ones() -> None:
    """``keygen`` makes only pairs whose public key does not look like a private key."""
    for _ in range(200):
        private = keys.generate_private_key()
        assert keys.looks_private(keys.decode_key(private))
        assert not keys.looks_private(keys.decode_key(keys.public_key_text(private)))


def test_own_private_key_as_public_key(load: Load, tmp_path: Path) -> None:
    """It is exposed by that: the remedy is a new key."""
    own = (tmp_path / "drone0.key").read_text().strip()
    said = _problem(load, _config(own), own)
    assert "peer[0].public_key (drone1): is this daemon's private key" in said
    assert "make a new one with `uavlinkd keygen`" in said


def test_private_key_beside_the_file(load: Load, tmp_path: Path) -> None:
    """The file that holds the key is named, also if the key has no form of its own."""
    for name in ("drone1.key", "other.txt"):
        secret = base64.b64encode(bytes([1]) + secrets.token_bytes(30) + bytes([0])).decode()
        (tmp_path / name).write_text(secret + "\n")
        said = _problem(load, _config(secret), secret)
        assert f"is the secret key in {name}" in said
        assert "make a new one there with `uavlinkd keygen`" in said


def test_private_key_of_another_peer(load: Load) -> None:
    """Its public half is the key of another peer."""
    private = keys.generate_private_key()
    other = (
        f'[[peer]]\nname = "drone2"\npublic_key = "{keys.public_key_text(private)}"\nrole = "swarm-member"\n'
        "system_ids = [3]\n"
    )
    assert 'is the private key of peer "drone2"' in _problem(load, _config(private, other), private)


def test_psk_as_public_key(load: Load, tmp_path: Path) -> None:
    """The PSK of its file."""
    psk = base64.b64encode(secrets.token_bytes(31) + bytes([1])).decode()  # always a valid public key too
    (tmp_path / "pair.psk").write_text(psk)
    assert "is a PSK, which must stay secret" in _problem(load, _config(psk, 'psk_file = "pair.psk"\n'), psk)


def test_public_key_in_a_file_beside_the_configuration_is_fine(load: Load, tmp_path: Path) -> None:
    """People write what keygen prints into a file."""
    public = keys.public_key_text(keys.generate_private_key())
    (tmp_path / "drone1.pub").write_text(public + "\n")
    assert load(_config(public)).peers[0].settings.public_key == keys.decode_key(public)


def test_public_key_in_the_private_key_file(load: Load, tmp_path: Path) -> None:
    """The peer's own key in the file of the private key: no secret is exposed."""
    public = keys.public_key_text(keys.generate_private_key())
    (tmp_path / "drone0.key").write_text(public)
    with pytest.raises(ConfigError, match=r"private_key_file: holds the public key of peer\[0\] \(drone1\)"):
        load(_config(public))
    other = keys.public_key_text(keys.generate_private_key())
    (warning,) = load(_config(other)).warnings
    assert "private_key_file holds a key without the form of a private key" in warning


def test_private_key_of_another_machine_is_suspected(load: Load) -> None:
    """Its file is not here. Its form shows it; a key of ``wg`` may have it too, so this is a warning."""
    private = keys.generate_private_key()
    (warning,) = load(_config(private)).warnings
    assert "has the form of a private key" in warning
    assert "make a new one there with `uavlinkd keygen`" in warning
    assert private[:8] not in warning


def test_keys_of_the_examples_are_known() -> None:
    """Each public key in README.md, the packages' pages and configs/ is in the list, and no other."""
    pages = [ROOT / "README.md", *(ROOT / "configs").rglob("*.*"), *(ROOT / "uavlinkd").rglob("*.md")]
    shown = {key for page in pages for key in _KEY.findall(page.read_text(errors="replace"))}
    assert shown == EXAMPLE_KEYS


@pytest.mark.parametrize("key", sorted(EXAMPLE_KEYS))
def test_key_of_an_example_is_warned_of(load: Load, key: str) -> None:
    """A reader copied it with the file."""
    (warning,) = load(_config(key)).warnings
    assert warning.startswith('peer "drone1": public_key is the key of an example')
    assert "`uavlinkd pubkey` printed on the peer" in warning


@pytest.mark.parametrize("what", ["relay", "member"])
def test_relays_and_members_are_looked_at_too(load: Load, what: str) -> None:
    """The key of an example, and the private key of another machine."""
    more = {"relay": 'addresses = ["192.0.2.1:5790"]', "member": "[relay_server]\nenabled = true"}[what]
    private = keys.generate_private_key()
    for key, words in ((min(EXAMPLE_KEYS), "the key of an example"), (private, "the form of a private key")):
        config = _config(keys.public_key_text(keys.generate_private_key()), "confidential = true\n")
        warnings = load(f'{config}[[{what}]]\nname = "vps"\npublic_key = "{key}"\n{more}\n').warnings
        (warning,) = (warning for warning in warnings if "public_key" in warning)
        assert warning.startswith(f'{what} "vps": public_key')
        assert words in warning
        assert f"on the {what}" in warning
        assert private[:8] not in warning
