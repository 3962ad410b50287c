"""The command ``uavlinkd web``."""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import ssl
from base64 import b32encode
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from uavlinkd.config.keys import KeyFileError, find_secret_file, read_private_file, write_secret_file
from uavlinkd.config.tls_files import TlsFileError, load_tls
from uavlinkd.core.crypto import sha256
from uavlinkd.ops.commands import control_socket, for_daemon
from uavlinkd.system.addresses import Address, AddressError, parse_address
from uavlinkd.system.terminal import OK, CommandError, UsageError, printable

if TYPE_CHECKING:
    from uavlinkd.web.page import Page

DEFAULT: Final = "127.0.0.1:8790"
_PASSWORD_BYTES: Final = 15  # 120 random bits: no guess finds them, so a fast hash protects them
_GROUP: Final = 6
_HASH: Final = "sha256:"
_FILE_LIMIT: Final = 200
_HOW: Final = "`uavlinkd web --new-password --password-file FILE` makes one"


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    web = for_daemon(commands, "web", _web, "show a daemon's links in a browser")
    web.add_argument("--listen", metavar="IP:PORT", default=DEFAULT, help="where the page is (default: %(default)s)")
    web.add_argument(
        "--name",
        metavar="HOST",
        action="append",
        default=[],
        help="a host name in the page's address, such as that of a reverse proxy; may be repeated",
    )
    web.add_argument("--password-file", metavar="FILE", type=Path, help="the hash of the page's password")
    web.add_argument(
        "--new-password", action="store_true", help="make a password, write its hash to --password-file, and end"
    )
    web.add_argument("--certificate", metavar="FILE", type=Path, help="for HTTPS, in PEM")
    web.add_argument("--key", metavar="FILE", type=Path, help="that of the certificate, in PEM without a passphrase")


def _web(options: argparse.Namespace) -> int:
    if options.new_password:
        return _make_password(options.password_file)
    try:
        address = parse_address(options.listen, allow_names=False)
    except AddressError as error:
        raise UsageError(f"--listen {error}") from None
    _check(options, address)
    password_hash, tls = _read_hash(options.password_file), _read_tls(options)
    socket = control_socket(options)
    try:
        from uavlinkd.web.page import Page  # noqa: PLC0415  of the extra
    except ModuleNotFoundError as error:
        raise CommandError(
            f"uavlinkd web needs the extra `web` ({error.name} is missing). In a checkout: pip install '.[web]'"
        ) from None
    page = Page(socket, address, frozenset(name.lower() for name in options.name), password_hash, tls)
    with page:
        print(printable(f"the page is at {page.url} until Ctrl-C"), flush=True)
        with suppress(KeyboardInterrupt):
            asyncio.run(_until_ended(page))
    return OK


async def _until_ended(page: Page) -> None:
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
