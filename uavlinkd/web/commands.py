"""The command ``uavlinkd web``: its arguments. What it needs is imported when it runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from uavlinkd.ops.commands import add_daemon
from uavlinkd.system.terminal import CommandError

DEFAULT: Final = "127.0.0.1:8790"


def add_arguments(web: argparse.ArgumentParser) -> None:
    add_daemon(web)
    web.set_defaults(command=_web)
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
    with of_the_extra("uavlinkd web"):
        from uavlinkd.web.start import start  # noqa: PLC0415
    return start(options)


@contextmanager
def of_the_extra(command: str) -> Iterator[None]:
    """Imports that need the extra. Raises CommandError with the remedy if it is not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise CommandError(
            f"{command} needs the extra `web` ({error.name} is missing). In a checkout:"
            f" {sys.executable} -m pip install '.[web]'"
        ) from None
