"""Key files: the format of WireGuard, readable by their owner only."""

from __future__ import annotations

import base64
import json
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.config import keys
from uavlinkd.config.keys import KeyFileError

_VECTORS = Path(__file__).parents[1] / "vectors" / "noise.json"


@given(st.binary(min_size=32, max_size=32))
def test_key_survives_its_text(key: bytes) -> None:
    """Any 32 bytes can be decoded from their 44 characters, with or without a newline."""
    text = keys.encode_key(key)
    assert len(text) == keys.KEY_TEXT_LENGTH
    assert keys.decode_key(text) == keys.decode_key(f"{text}\n") == key


@pytest.mark.parametrize(
    "text",
    [
        "",
        "=",
        base64.b64encode(bytes(31)).decode(),
        base64.b64encode(bytes(33)).decode(),
        base64.b64encode(bytes(32)).decode().rstrip("="),
        "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAB=",  # unused bits set in the last character
        "AAAAAAAAAAAAAAAAAAAAA\nAAAAAAAAAAAAAAAAAAAAAA=",
        "-_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=",  # the URL alphabet
        "é" * 44,
        bytes(32).hex(),
    ],
)
def test_other_text_is_refused_and_not_repeated(text: str) -> None:
    """A key has only one spelling, and the message contains no part of the text."""
    with pytest.raises(ValueError, match="is not a key") as caught:
        keys.decode_key(text)
    assert len(text) < 2 or text not in str(caught.value)


def test_generated_keys_are_those_of_wireguard() -> None:
    """Each differs. A private key has the bits that X25519 sets, as by ``wg genkey`` (RFC 7748, section 5).

    No public key has them, so both kinds are distinguished.
    """
    private = [keys.generate_private_key() for _ in range(200)]
    assert len({*private, keys.generate_psk(), keys.generate_psk()}) == 202
    for text in private:
        key = keys.decode_key(text)
        assert (key[0] & 7, key[31] & 192) == (0, 64)
        assert keys.looks_private(key)
        assert not keys.looks_private(keys.decode_key(keys.public_key_text(text)))


def test_public_key_is_the_one_of_published_vectors() -> None:
    """The Noise vectors contain responders' key pairs: each initiator knows the public half."""
    pairs = {
        (vector["resp_static"], vector["init_remote_static"])
        for vector in json.loads(_VECTORS.read_text())["vectors"]
        if "init_remote_static" in vector
    }
    assert pairs
    for private, public in pairs:
        text = keys.encode_key(bytes.fromhex(private))
        assert keys.public_key_text(f"{text}\n") == keys.encode_key(bytes.fromhex(public))


def test_written_key_is_its_owners_alone(tmp_path: Path) -> None:
    """A new file has mode 0600 whatever the umask, ends in a newline, and is read back."""
    path = tmp_path / "drone0.key"
    text = keys.generate_private_key()
    before = os.umask(0)
    try:
        keys.write_secret_file(path, text)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_text() == f"{text}\n"
    assert keys.read_secret_file(path).reveal() == keys.decode_key(text)


def test_key_is_never_overwritten(tmp_path: Path) -> None:
    """A new key replaces neither a file nor a dangling link."""
    path = tmp_path / "drone0.key"
    path.write_text("precious")
    link = tmp_path / "link.key"
    link.symlink_to(tmp_path / "elsewhere")
    for taken in (path, link):
        with pytest.raises(KeyFileError, match="never overwritten"):
            keys.write_secret_file(taken, keys.generate_psk())
    assert path.read_text() == "precious"
    assert not (tmp_path / "elsewhere").exists()
    with pytest.raises(KeyFileError, match="No such file"):
        keys.write_secret_file(tmp_path / "none" / "drone0.key", keys.generate_psk())


def test_failed_write_leaves_no_half_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk leaves no file that would make the next attempt fail."""

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    path = tmp_path / "drone0.key"
    with pytest.raises(KeyFileError, match="No space left"):
        keys.write_secret_file(path, keys.generate_psk())
    assert not path.exists()


def _key_file(path: Path, mode: int = 0o600) -> Path:
    path.write_text(keys.generate_private_key() + "\n")
    path.chmod(mode)
    return path


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o644, 0o660, 0o666, 0o610, 0o601])
def test_key_that_others_may_touch_is_refused_with_the_remedy(tmp_path: Path, mode: int) -> None:
    """The group and others may have no right, and the message names the command to run."""
    path = _key_file(tmp_path / "drone 0.key", mode)
    with pytest.raises(KeyFileError) as caught:
        keys.read_secret_file(path)
    assert f"chmod 600 '{path}'" in str(caught.value)
    assert path.read_text().strip() not in str(caught.value)
    for allowed in (0o400, 0o600, 0o700):
        path.chmod(allowed)
        assert keys.encode_key(keys.read_secret_file(path).reveal()) == path.read_text().strip()


@pytest.mark.parametrize("credential", [False, True])
def test_key_of_another_owner_is_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, credential: bool
) -> None:
    """Its owner can replace it at any time, in any mode; this holds for credentials too."""
    path = _key_file(tmp_path / "drone 0.key")
    owner = path.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    fstat = os.fstat
    monkeypatch.setattr(os, "fstat", lambda descriptor: _owned(fstat(descriptor), 4242))
    with pytest.raises(KeyFileError, match="uid 4242") as caught:
        keys.read_secret_file(path, credential=credential)
    assert f"chown {owner + 1} '{path}'" in str(caught.value)
    assert path.read_text().strip() not in str(caught.value)


@pytest.mark.parametrize("owner", [0, 1000])
def test_key_of_root_or_of_the_user_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: int) -> None:
    """Root can read every file anyway, and systemd's credentials belong to root."""
    path = _key_file(tmp_path / "drone0.key")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    fstat = os.fstat
    monkeypatch.setattr(os, "fstat", lambda descriptor: _owned(fstat(descriptor), owner))
    assert keys.encode_key(keys.read_secret_file(path).reveal()) == path.read_text().strip()


def _owned(status: os.stat_result, owner: int) -> os.stat_result:
    return os.stat_result((*status[:4], owner, *status[5:10]))


def test_credential_may_show_the_groups_right_to_read(tmp_path: Path) -> None:
    """systemd's access control list appears as mode 0440; no other right of the group or of others is allowed."""
    path = _key_file(tmp_path / "a", 0o440)
    secret = keys.read_secret_file(path, credential=True)
    assert keys.encode_key(secret.reveal()) == path.read_text().strip()
    for mode in (0o444, 0o460):
        with pytest.raises(KeyFileError, match="chmod"):
            keys.read_secret_file(_key_file(tmp_path / f"b{mode}", mode), credential=True)


def test_only_a_regular_file_is_read(tmp_path: Path) -> None:
    """A pipe without a writer does not stop the daemon; a folder and a device are refused."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    for path in (pipe, tmp_path, Path(os.devnull)):
        with pytest.raises(KeyFileError, match="not a regular file"):
            keys.read_secret_file(path)
    with pytest.raises(KeyFileError, match="no such file"):
        keys.read_secret_file(tmp_path / "drone0.key")
    with pytest.raises(KeyFileError, match="not a file name"):
        keys.read_secret_file(tmp_path / "a\0b")


@pytest.mark.parametrize("content", [b"", b"secret words", b"\xff" * 44, bytes(32), b"A" * 10_000])
def test_invalid_content_is_refused_and_not_repeated(tmp_path: Path, content: bytes) -> None:
    """The message describes the format of a key, and contains no part of the content."""
    path = tmp_path / "drone0.key"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(KeyFileError, match="44 characters") as caught:
        keys.read_secret_file(path)
    assert "secret words" not in str(caught.value)
    path.write_text(keys.encode_key(bytes(32)))  # a PSK of zeros equals none, and everyone knows such a private key
    with pytest.raises(KeyFileError, match="all zeros"):
        keys.read_secret_file(path)


def test_credential_comes_first(tmp_path: Path) -> None:
    """systemd passed it to this service: a file of the same name beside the configuration does not replace it."""
    folder, credentials = tmp_path / "etc", tmp_path / "credentials"
    folder.mkdir()
    credentials.mkdir()
    environ = {"CREDENTIALS_DIRECTORY": str(credentials)}
    for path in (folder / "drone0.key", credentials / "drone0.key"):
        path.touch()
    assert keys.find_secret_file("drone0.key", folder, environ) == (credentials / "drone0.key", True)
    assert keys.find_secret_file("drone0.key", folder, {}) == (folder / "drone0.key", False)
    assert keys.find_secret_file("other.key", folder, environ) == (folder / "other.key", False)
    assert keys.find_secret_file("/etc/a.key", folder, environ) == (Path("/etc/a.key"), False)


def test_credential_name_cannot_leave_the_folder(tmp_path: Path) -> None:
    """The laxer check of a credential applies only to files in that folder."""
    (tmp_path / "outside").touch()
    (tmp_path / "credentials" / "sub").mkdir(parents=True)
    (tmp_path / "credentials" / "sub" / "key").touch()
    environ = {"CREDENTIALS_DIRECTORY": str(tmp_path / "credentials")}
    for name in ("../outside", "sub/key", "..", "."):
        assert keys.find_secret_file(name, tmp_path, environ)[1] is False
