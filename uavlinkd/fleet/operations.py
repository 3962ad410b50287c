"""The operations on a fleet's folder: init, sign, revoke, restore and publish.

A fleet's folder contains the manifest and the authority's key. An operation that raises FleetError changed nothing.
The manifest is replaced as a whole before a line is printed: a serial is never used twice, and each member that was
signed is known, wherever the command was killed.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from uavlinkd.authority.enrolment import FleetError, Request
from uavlinkd.authority.trust import BulletinVerdict
from uavlinkd.config import keys
from uavlinkd.fleet import authority_key, signing
from uavlinkd.fleet.authority_key import AUTHORITY_FILE, Passphrase
from uavlinkd.fleet.files import reply_for
from uavlinkd.fleet.manifest import (
    FILE_NAME,
    Fleet,
    FleetFileError,
    check_suite,
    file_errors,
    no_fleet,
    read_manifest,
    write_manifest,
)
from uavlinkd.fleet.recovery import recovered
from uavlinkd.fleet.signing import Identity
from uavlinkd.ops.control import ask as ask_daemon
from uavlinkd.protocol.crypto import Secret, SigningKey, signing_key_pem, x25519_public_key
from uavlinkd.system.base64_text import to_base64
from uavlinkd.system.folders import replace_file

_AT_ONCE = 30  # certificates in a request, which has at most 8,192 bytes


def init(folder: Path, suite: str, ask: Passphrase | None, *, swarm: bool = False) -> Secret:
    """Create a fleet in a new folder, and return the authority's key. If a step fails, there is no folder.

    ``ask`` is called for a new passphrase; None: the key is not encrypted.
    """
    check_suite(suite)
    private = Secret(secrets.token_bytes(32))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FleetError(f"{folder} exists already: choose the name of a new folder, or use `uavlinkd fleet sign`")
    pem = signing_key_pem(private, None if ask is None else ask(AUTHORITY_FILE), os.urandom)
    building = folder.with_name(f".{folder.name}.new")
    with file_errors():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with lock(folder.parent):
            shutil.rmtree(building, ignore_errors=True)  # of a command that was killed
            try:
                building.mkdir(mode=0o755)
                keys.write_secret_file(building / AUTHORITY_FILE, pem)
                _save(building, signing.new_fleet(SigningKey(private), suite, swarm=swarm))
                building.rename(folder)
            finally:
                shutil.rmtree(building, ignore_errors=True)
    return private


def sign(
    folder: Path, request: Request, identity: Identity, ask: Passphrase, *, replaces: bool = False
) -> tuple[Fleet, Fleet]:
    """Sign a request, and return the fleet before and after it.

    The same request again, for the same identity, changes nothing. ``replaces``: it is for a new key of a member.
    """
    with lock(folder):
        before = read_manifest(folder)
        known = next((member for member in before.current if member.public_key == request.public_key), None)
        if known is not None and known.name == request.name and identity.is_of(known):
            return before, before
        signer = _signer(folder, before, ask)
        after = signing.certify(before, signer, request.public_key, request.name, identity, replaces=replaces)
        _save(folder, after)
    return before, after


def check_signing(folder: Path, name: str, identity: Identity, ask: Passphrase, *, replaces: bool) -> None:
    """Check that :func:`sign` would accept any new key of a member. Raises FleetError as it does."""
    fleet, key = read_manifest(folder), x25519_public_key(secrets.token_bytes(32))
    signing.certify(fleet, _signer(folder, fleet, ask), key, name, identity, replaces=replaces)


def line_of(fleet: Fleet, name: str) -> str:
    """The reply line of a member, with the present bulletin and contacts."""
    return reply_for(fleet, fleet.member(name)).line()


def revoke(folder: Path, name: str, ask: Passphrase) -> tuple[Fleet, Fleet]:
    """Sign a bulletin that refuses a member, and return the fleet before and after it. Once more changes nothing."""
    with lock(folder):
        before = read_manifest(folder)
        if before.former(name) is not None:
            return before, before
        member = before.member(name)
        after = signing.revoke(before, _signer(folder, before, ask), member)
        _save(folder, after)
    return before, after


def restore(folder: Path, private: Secret, ask: Passphrase | None, sources: Sequence[dict[str, Any]] = ()) -> Fleet:
    """Write the authority's key from its paper copy, with a new passphrase, unless the file exists.

    ``sources``: what members have of the fleet, if the folder is lost too.
    """
    fleet = recovered(sources) if sources else read_manifest(folder)
    if SigningKey(private).public != fleet.authority.public:
        raise FleetError("this paper copy is of another authority than this fleet's")
    pem = signing_key_pem(private, None if ask is None else ask(AUTHORITY_FILE), os.urandom)
    with file_errors():
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        with lock(folder):
            if sources and not os.path.lexists(folder / AUTHORITY_FILE):
                _save(folder, fleet)
            keys.write_secret_file(folder / AUTHORITY_FILE, pem)
    return fleet


def publish(folder: Path, socket: Path, ask: Passphrase, *, merges: bool = False) -> Fleet:
    """Hand the bulletin and the certificates of all members to the daemon at a control socket.

    The daemon may have another bulletin of the same number, which another copy of the folder signed: then their union
    is signed and handed over. ``merges``: a newer one too.
    """
    fleet = read_manifest(folder)
    theirs = str(ask_daemon(socket, "bulletin").get("bulletin"))
    bulletin, own = signing.bulletin_of(fleet, theirs), fleet.bulletin.number
    if bulletin.number > own and not merges:
        raise FleetError(
            f"the fleet has bulletin {bulletin.number}, this folder {own}: use the newest copy of the folder. If that"
            " is lost, --merge signs the union of both; members that were signed there are not in this folder"
        )
    if bulletin.number > own or (bulletin.number == own and theirs != to_base64(fleet.published)):
        with lock(folder):
            before = read_manifest(folder)
            fleet = signing.merge(before, _signer(folder, before, ask), bulletin)
            _save(folder, fleet)
    certificates = [f"{to_base64(one.public_key)}:{to_base64(one.signed)}" for one in fleet.current]
    for at in range(0, len(certificates), _AT_ONCE):
        ask_daemon(socket, " ".join(["publish", theirs, *certificates[at : at + _AT_ONCE]]))
    verdict = ask_daemon(socket, f"publish {to_base64(fleet.published)}").get("verdict")
    if verdict not in (BulletinVerdict.NEWER.value, BulletinVerdict.KNOWN.value):
        raise FleetError(f"the daemon refused bulletin {fleet.bulletin.number}: {verdict}")
    return fleet


def _signer(folder: Path, fleet: Fleet, ask: Passphrase) -> SigningKey:
    signer = SigningKey(authority_key.load_key(folder / AUTHORITY_FILE, ask))
    if signer.public != fleet.authority.public:
        raise FleetError(f"{folder / AUTHORITY_FILE} is the key of another fleet's authority")
    return signer


def _save(folder: Path, fleet: Fleet) -> None:
    with file_errors():
        replace_file(folder / FILE_NAME, write_manifest(fleet).encode())


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a fleet's folder: two commands must not overwrite each other's change.

    The lock is on the folder itself: no lock file remains, and the kernel releases it when the process ends,
    however it ends. Raises FleetError if the folder does not exist or another command has the lock, FleetFileError if
    it cannot be locked.
    """
    import fcntl  # noqa: PLC0415  Windows has no such module

    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        raise no_fleet(folder) from None
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be read: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise FleetError(f"another fleet command runs in {folder}: run this one again when it has ended") from None
    finally:
        os.close(descriptor)
