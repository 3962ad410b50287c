"""Keys as files: 32 bytes in base64 on one line, as WireGuard's ``genkey``, ``pubkey`` and ``genpsk`` write.

Nothing here repeats what a file holds, not even in part: a message about a key names the file.
"""

from __future__ import annotations

import base64
import binascii
import os
import secrets
import shlex
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from uavlinkd.core.constants import KEY_BYTES
from uavlinkd.core.crypto import Secret, x25519_public_key

KEY_TEXT_LENGTH = 44
"""Characters of a key in base64."""
CREDENTIALS = "CREDENTIALS_DIRECTORY"
"""The environment variable in which systemd names the folder with a service's keys."""
_READ_LIMIT = 256
"""Bytes read of a key file: enough to see that there is more than a key."""
_FIELD_PRIME = 2**255 - 19
"""The field of X25519 (RFC 7748, section 4.1)."""


class KeyFileError(Exception):
    """A key file that cannot be used or written. The message names the file and the remedy, never a key."""


def generate_private_key() -> str:
    """A new private key, from the operating system's generator.

    The bits that X25519 sets and clears in any case (RFC 7748, section 5) are so already, as ``wg genkey`` has it.
    """
    key = bytearray(secrets.token_bytes(KEY_BYTES))
    key[0] &= 248
    key[31] = key[31] & 127 | 64
    return encode_key(bytes(key))


def generate_psk() -> str:
    """A new pre-shared key, from the operating system's generator."""
    return encode_key(secrets.token_bytes(KEY_BYTES))


def public_key_text(private_text: str) -> str:
    """The public key of a private key, both in base64.

    Raises:
        ValueError: the text is no key; the message does not repeat it.
    """
    return encode_key(x25519_public_key(decode_key(private_text)))


def encode_key(key: bytes) -> str:
    """32 bytes in base64."""
    return base64.b64encode(key).decode("ascii")


def decode_key(text: str) -> bytes:
    """The 32 bytes of a key in base64. A newline or spaces around it do not matter.

    Only the one spelling that WireGuard writes is taken: Python's decoder would also take loose bits at the
    end, and two spellings of a key would count as two keys.

    Raises:
        ValueError: with a message that does not repeat the text.
    """
    stripped = text.strip()
    try:
        key = base64.b64decode(stripped, validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if len(key) != KEY_BYTES or encode_key(key) != stripped:
        raise ValueError(f"is no key: one has {KEY_TEXT_LENGTH} characters of base64, the last of them =")
    return key


def is_canonical_public_key(public: bytes) -> bool:
    """Whether X25519 could have given these bytes: a number below the field's prime.

    Larger ones are taken modulo the prime, so the same point would have a second name.
    """
    return int.from_bytes(public, "little") < _FIELD_PRIME


def short_form(public: bytes) -> str:
    """The first characters of a public key, by which a person knows it again."""
    return encode_key(public)[:8] + "..."


def write_secret_file(path: Path, text: str) -> None:
    """Write a key to a new file that its owner alone may read, safe against a power cut.

    Raises:
        KeyFileError: the file exists (a key is never overwritten), or could not be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o600)
    except FileExistsError:
        raise KeyFileError(f"{path}: exists, and keys are never overwritten: move it away") from None
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be made: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            # Against a umask that takes the owner's rights too.
            os.fchmod(file.fileno(), 0o600)
            file.write(text.strip() + "\n")
            file.flush()
            os.fsync(file.fileno())
        _sync_folder(path.parent)
    except BaseException as error:
        # Half a key is worse than none: the next try would find a file in its way.
        with suppress(OSError):
            path.unlink()
        if isinstance(error, OSError):
            raise KeyFileError(f"{path}: cannot be written: {error.strerror}") from None
        raise


def _sync_folder(folder: Path) -> None:
    """Make the new name itself last."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def find_secret_file(name: str, folder: Path, environ: Mapping[str, str]) -> tuple[Path, bool]:
    """Where a key file is, and whether it is a systemd credential.

    A credential of that name is taken first (systemd.exec(5), LoadCredential=), or one that systemd found in a folder
    handed over as ``keys``, which it calls ``keys_NAME``; its name has no folder in it. Else ``name`` is relative to
    ``folder``.
    """
    path = folder / name
    credentials = environ.get(CREDENTIALS, "")
    if credentials and name not in (".", "..") and "/" not in name:
        for each in (name, f"keys_{name}"):
            credential = Path(credentials) / each
            if os.path.lexists(credential):
                return credential, True
    return path, False


def read_secret_file(path: Path, *, credential: bool = False) -> Secret:
    """The key in a regular file of this process's user or of root, to which no other user has a right.

    A file's owner can always change it and its mode, so a key file of another user is refused (as by sshd).

    ``credential``: systemd grants a service its credentials through an access list, whose mask shows as the
    group's right to read. In the service's own folder that is no exposure, so it is let pass there.

    Raises:
        KeyFileError: with the remedy.
    """
    try:
        # O_NONBLOCK: opening a pipe must not wait for its writer. The checks are made on what was opened.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise KeyFileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise KeyFileError(f"{path}: cannot be opened: {reason}") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise KeyFileError(f"{path}: is not a regular file")
        if status.st_uid not in (0, os.geteuid()):
            raise KeyFileError(f"{path}: {_owned_by_another(path, status.st_uid)}")
        allowed = 0o740 if credential else 0o700
        if excess := stat.S_IMODE(status.st_mode) & 0o777 & ~allowed:
            raise KeyFileError(f"{path}: {_who(excess)}: run `chmod 600 {shlex.quote(str(path))}`")
        content = os.read(descriptor, _READ_LIMIT)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
    finally:
        os.close(descriptor)
    try:
        key = decode_key(content.decode("ascii", errors="replace"))
    except ValueError as error:
        raise KeyFileError(f"{path}: {error}; nothing else may be in the file") from None
    if not any(key):
        raise KeyFileError(f"{path}: is all zeros, a key that everybody knows: make another")
    return Secret(key)


def _owned_by_another(path: Path, owner: int) -> str:
    quoted = shlex.quote(str(path))
    return (
        f"belongs to another user (uid {owner}), who can read and replace it: if the key is known to be yours, run"
        f" `chown {os.geteuid()} {quoted}` as root, or this command as that user"
    )


def _who(excess: int) -> str:
    whom = " and ".join(name for name, bits in (("its group", 0o070), ("others", 0o007)) if excess & bits)
    what = "read" if excess & 0o044 else "change" if excess & 0o022 else "execute"
    return f"{whom} may {what} it"
