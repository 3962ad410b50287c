"""Keys as files: 32 bytes in base64 on one line, as WireGuard's ``genkey``, ``pubkey`` and ``genpsk`` write.

No message repeats the content of a key file, not even in part: a message about a key names the file.
"""

from __future__ import annotations

import os
import shlex
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.protocol.crypto import FIELD_PRIME, Secret, x25519_public_key
from uavlinkd.system.base64_text import from_base64, to_base64
from uavlinkd.system.folders import sync_folder
from uavlinkd.system.terminal import CommandError

KEY_TEXT_LENGTH = 44
CREDENTIALS = "CREDENTIALS_DIRECTORY"
"""The environment variable in which systemd names the folder with a service's keys."""
_READ_LIMIT = 256  # bytes read of a key file: enough to detect that it contains more than a key
_HAS_OWNERS = hasattr(os, "geteuid")
"""Files have owners and modes, and folders can be synced. Windows has none of this, and no flags for these files."""
_NONBLOCK, _CLOEXEC = getattr(os, "O_NONBLOCK", 0), getattr(os, "O_CLOEXEC", 0)


class KeyFileError(CommandError):
    """A key file that cannot be used or written. The message names the file and the remedy, never a key."""


def generate_private_key() -> str:
    """A new private key, from the operating system's generator, in the form of ``wg genkey`` (RFC 7748, section 5).

    One of 16 public keys has this form too. Then another pair is made, so that :func:`looks_private` distinguishes
    every private key from every public key.
    """
    while True:
        key = bytearray(os.urandom(KEY_BYTES))
        key[0] &= 248
        key[31] = key[31] & 127 | 64
        if not looks_private(x25519_public_key(bytes(key))):
            return encode_key(bytes(key))


def looks_private(key: bytes) -> bool:
    """Whether a key has the fixed bits of a private key of ``uavlinkd keygen`` or ``wg genkey``.

    No public key of ``uavlinkd keygen`` has them, and one of 16 public keys of other software.
    """
    return key[0] & 7 == 0 and key[31] & 0xC0 == 0x40


def generate_psk() -> str:
    """A new pre-shared key, from the operating system's generator."""
    return encode_key(os.urandom(KEY_BYTES))


def public_key_text(private_text: str) -> str:
    """The public key of a private key, both in base64. Errors as of :func:`decode_key`."""
    return encode_key(x25519_public_key(decode_key(private_text)))


def encode_key(key: bytes) -> str:
    return to_base64(key)


def decode_key(text: str) -> bytes:
    """The 32 bytes of a key in base64. A newline or spaces around it do not matter.

    Only the spelling that WireGuard writes is accepted: two spellings of a key would count as two keys.
    Raises ValueError with a message that does not repeat the text.
    """
    try:
        key = from_base64(text.strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError(f"is not a key: a key has {KEY_TEXT_LENGTH} characters of base64 and ends in =")
    return key


def is_canonical_public_key(public: bytes) -> bool:
    """Whether X25519 can return these bytes: a number below the field's prime.

    X25519 reduces larger numbers modulo the prime, so the same point would have two encodings.
    """
    return int.from_bytes(public, "little") < FIELD_PRIME


def write_secret_file(path: Path, text: str) -> None:
    """Write a key in ASCII, as :func:`write_private_file` does."""
    write_private_file(path, text.strip().encode("ascii") + b"\n")


def write_private_file(path: Path, data: bytes) -> None:
    """Write a new file that only its owner may read, and sync it to the disk. It appears whole, or not at all.

    Raises KeyFileError if the file exists (a key is never overwritten), or cannot be written.
    """
    if os.path.lexists(path):
        raise KeyFileError(f"{path}: exists, and keys are never overwritten: move it away")
    new = path.with_name(f".{path.name}.new")
    try:
        new.unlink(missing_ok=True)  # of a command that was killed
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _CLOEXEC, 0o600)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be made: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            # A umask could remove the owner's rights too.
            if _HAS_OWNERS:
                os.fchmod(file.fileno(), 0o600)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        new.rename(path)
        sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            new.unlink()
        if isinstance(error, OSError):
            raise KeyFileError(f"{path}: cannot be written: {error.strerror}") from None
        raise


def find_secret_file(name: str, folder: Path, environ: Mapping[str, str]) -> tuple[Path, bool]:
    """The path of a key file, and whether it is a systemd credential.

    A credential with that name comes first (systemd.exec(5), LoadCredential=). Then comes ``keys_NAME``, systemd's
    name for a file in a folder that it loads as ``keys``. A credential's name contains no folder. Otherwise ``name``
    is relative to ``folder``.
    """
    credentials = environ.get(CREDENTIALS, "")
    if credentials and name not in (".", "..") and "/" not in name:
        for credential in (Path(credentials) / name, Path(credentials) / f"keys_{name}"):
            if os.path.lexists(credential):
                return credential, True
    return folder / name, False


def read_secret_file(path: Path, *, credential: bool = False) -> Secret:
    """The key in a file that :func:`read_private_file` accepts. Raises KeyFileError with the remedy."""
    content = read_private_file(path, _READ_LIMIT, credential=credential)
    try:
        key = decode_key(content.decode("ascii", errors="replace"))
    except ValueError as error:
        raise KeyFileError(f"{path}: {error}; the file may contain only the key") from None
    if not any(key):
        raise KeyFileError(f"{path}: is all zeros, a key that everyone knows: make another")
    return Secret(key)


def read_private_file(path: Path, limit: int, *, credential: bool = False) -> bytes:
    """The first bytes of a regular file of this process's user or of root that no other user may access.

    A file's owner can always change it and its mode, so a key file of another user is refused (as by sshd).

    ``credential``: systemd grants a service its credentials through an access control list, whose mask appears as
    the group's right to read. The folder is the service's own, so this right is allowed there.
    Raises KeyFileError with the remedy.
    """
    try:
        # O_NONBLOCK: opening a pipe must not wait for its writer. The checks apply to the opened file.
        descriptor = os.open(path, os.O_RDONLY | _NONBLOCK | _CLOEXEC)
    except FileNotFoundError:
        raise KeyFileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise KeyFileError(f"{path}: cannot be opened: {reason_of(error)}") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise KeyFileError(f"{path}: is not a regular file")
        if _HAS_OWNERS:
            _check_access(path, status, 0o740 if credential else 0o700)
        return os.read(descriptor, limit)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
    finally:
        os.close(descriptor)


def reason_of(error: OSError | ValueError) -> str:
    """Why a file cannot be opened, with the remedy if another user can. ValueError: a name with a zero byte."""
    if isinstance(error, PermissionError):
        return f"{error.strerror}: run this command as the file's owner, or with sudo"
    return str(error.strerror) if isinstance(error, OSError) else "not a file name"


def _check_access(path: Path, status: os.stat_result, allowed: int) -> None:
    quoted = shlex.quote(str(path))
    if status.st_uid not in (0, os.geteuid()):
        raise KeyFileError(
            f"{path}: belongs to another user (uid {status.st_uid}), who can read and replace it: if you are sure"
            f" that the key is yours, run `chown {os.geteuid()} {quoted}` as root, or run this command as that user"
        )
    if stat.S_IMODE(status.st_mode) & 0o777 & ~allowed:
        raise KeyFileError(f"{path}: its group or others have access to it: run `chmod 600 {quoted}`")
