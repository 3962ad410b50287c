"""The start of ``uavlinkd web``: its options are checked, and its files read, before it listens."""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import signal
import ssl
from base64 import b32encode
from contextlib import suppress
from pathlib import Path
from socket import gethostname
from typing import Final

import anyio

from uavlinkd.config.keys import KeyFileError, find_secret_file, read_private_file, write_secret_file
from uavlinkd.config.tls_files import TlsFileError, load_tls
from uavlinkd.ops.commands import control_socket
from uavlinkd.protocol.crypto import sha256
from uavlinkd.system.addresses import Address, AddressError, parse_address
from uavlinkd.system.terminal import OK, CommandError, UsageError, printable
from uavlinkd.web.page import Page

_PASSWORD_BYTES: Final = 15  # 120 random bits: no guess finds them, so a fast hash protects them
_GROUP: Final = 6
_HASH: Final = "sha256:"
_FILE_LIMIT: Final = 200
_HOW: Final = "`uavlinkd web --new-password --password-file FILE` makes one"


def start(options: argparse.Namespace) -> int:
    """Run the page until interrupted, or make its password. Returns the exit status. Raises CommandError."""
    if options.new_password:
        return _make_password(options.password_file)
    try:
        address = parse_address(options.listen, allow_names=False)
    except AddressError as error:
        raise UsageError(f"--listen {error}") from None
    _check(options, address)
    password_hash, tls = _read_hash(options.password_file), _read_tls(options)
    own = gethostname().lower()  # in a browser's address, only this machine has it
    names, socket = frozenset([own, f"{own}.local", *map(str.lower, options.name)]), control_socket(options)
    with Page(socket, address, names, password_hash, tls) as page:
        _leave_root(socket)
        print(printable(f"the page is at {page.url} until Ctrl-C"), flush=True)
        with suppress(KeyboardInterrupt):
            asyncio.run(_until_ended(page))
    return OK


def _leave_root(socket: Path) -> None:
    """After ``sudo``, become the user of the control socket: what answers browsers needs no more rights than that."""
    if os.geteuid() != 0:
        return
    if not socket.exists():
        raise CommandError(f"there is no {socket}: start the daemon first, or run this as its user and not as root")
    asyncio.run(asyncio.to_thread(anyio.run, anyio.sleep, 0))  # they import parts at first use: not readable later
    owner = socket.stat()
    os.setgroups([])
    os.setgid(owner.st_gid)
    os.setuid(owner.st_uid)


async def _until_ended(page: Page) -> None:
    gc.freeze()  # what is imported stays: the server looks for circles of objects among the rest
    task = asyncio.current_task()
    assert task is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    with suppress(asyncio.CancelledError):
        await page.run()


def _check(options: argparse.Namespace, address: Address) -> None:
    """Raises UsageError where other machines could look without a password, or read it on the network."""
    if (options.certificate is None) != (options.key is None):
        raise UsageError("--certificate and --key belong together: write both")
    if address.is_loopback:
        if options.name and options.password_file is None:
            raise UsageError(f"--name is for other machines, so the page needs --password-file FILE: {_HOW}")
        return
    if options.password_file is None or options.certificate is None:
        port = address.port
        raise UsageError(
            f"at {address} other machines can open the page, so it needs --password-file FILE ({_HOW}),"
            f" --certificate and --key. Or leave it at 127.0.0.1, and run `ssh -L {port}:127.0.0.1:{port} HOST` where"
            " the browser is"
        )


def _make_password(file: Path | None) -> int:
    if file is None:
        raise UsageError("--new-password needs --password-file FILE: where its hash is written")
    text = b32encode(os.urandom(_PASSWORD_BYTES)).lower()
    try:
        write_secret_file(file, f"{_HASH}{sha256(text).hex()}\n")
    except KeyFileError as error:
        raise CommandError(error) from None
    groups = [text[at : at + _GROUP].decode() for at in range(0, len(text), _GROUP)]
    print(f"password: {'-'.join(groups)}\nThe user name may be anything. {printable(str(file))} has only the hash.")
    return OK


def _found(file: Path) -> tuple[Path, bool]:
    """The path of a file that an option names, and whether it is a systemd credential."""
    return find_secret_file(str(file), Path(), os.environ)


def _read_hash(file: Path | None) -> bytes | None:
    if file is None:
        return None
    path, is_credential = _found(file)
    try:
        text = read_private_file(path, _FILE_LIMIT, credential=is_credential).decode("ascii", "replace").strip()
        read = bytes.fromhex(text.removeprefix(_HASH)) if text.startswith(_HASH) else b""
    except KeyFileError as error:
        raise UsageError(f"--password-file {error}: {_HOW}") from None
    except ValueError:
        read = b""
    if len(read) != len(sha256(b"")):
        raise UsageError(f"--password-file {path} does not have the hash of a password: {_HOW}")
    return read


def _read_tls(options: argparse.Namespace) -> ssl.SSLContext | None:
    if options.certificate is None:
        return None
    try:
        return load_tls(_found(options.certificate)[0], _found(options.key)[0])
    except TlsFileError as error:
        raise UsageError(error) from None
