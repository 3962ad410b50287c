"""``uavlinkd report``: one file for a support request, without keys and without the addresses of other machines."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from uavlinkd import __version__
from uavlinkd.core.path import WEB_HOST
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.ops.redaction import Redactor
from uavlinkd.system.terminal import CommandError, printable

COMMAND_TIMEOUT_S: Final = 60.0
LOG_LINES: Final = 300
MAX_SECTION: Final = 200_000  # characters of a section; of a longer one the end is kept
SERVICE_FILES: Final = Path("/etc/uavlinkd")
_PACKAGES: Final = (
    *("cryptography", "fastcrc", "prometheus_client", "pydantic", "rich", "serialx"),
    *("starlette", "structlog", "uvicorn", "uvloop", "websockets"),
)
_INTRODUCTION: Final = """\
uavlinkd report. Keys are replaced by key-1, …, the addresses of peers by
peer-address-1, …, and other addresses by address-1, …. The names of peers and
this machine's own addresses are readable. Read it before you send it."""


def make_report(configs: Sequence[Path], sockets: Sequence[Path]) -> str:
    interfaces = _run("ip", "-brief", "address")
    redactor = Redactor(re.findall(r"[0-9A-Fa-f:.]+(?=/\d)", interfaces))
    statuses = [_status(socket) for socket in sockets]
    log = _log()
    for address in _addresses_of_peers(configs, statuses, log):
        place = address.removeprefix(WEB_HOST).partition("/")[0]
        redactor.add_peer(place.rpartition(":")[0] or place)
    sections = [
        ("versions", _versions()),
        *((f"configuration {path}", _without_comments(path)) for path in configs),
        *((f"check {path}", _check(path)) for path in configs),
        *((f"status at {path}", json.dumps(one, indent=1)) for path, one in zip(sockets, statuses, strict=True)),
        ("log", log),
        ("sockets", _run("ss", "--no-header", "-lntup")),
        ("network interfaces", interfaces),
        ("routes", _run("ip", "route") + _run("ip", "-6", "route")),
    ]
    # Redacted before it is cut: the rest of a cut key has no form that shows what it is.
    parts = [
        f"## {redactor.redact(title)}\n\n{redactor.redact(text.strip())[-MAX_SECTION:]}" for title, text in sections
    ]
    return printable("\n\n".join([_INTRODUCTION, *parts]) + "\n", keep="\n")


def _versions() -> str:
    release = dict[str, str]()
    with suppress(OSError):
        release = platform.freedesktop_os_release()
    lines = [
        f"uavlinkd {__version__}, Python {platform.python_version()}, {platform.system()} {platform.release()}"
        f" {platform.machine()}",
        f"written at {time.strftime('%Y-%m-%d %H:%M:%S %z')}",
        release.get("PRETTY_NAME", "no /etc/os-release"),
    ]
    for name in _PACKAGES:
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            lines.append(f"{name}: not installed")
    return "\n".join(lines)


def _check(path: Path) -> str:
    folders = [folder for folder in (path.parent / "keys", path.with_suffix("")) if folder.is_dir()]
    keys = ["--keys", str(folders[0])] if folders else []
    return _run(sys.executable, "-m", "uavlinkd", "check", "--config", str(path), *keys)


def _status(socket: Path) -> dict[str, Any]:
    try:
        return ask(socket, "status")
    except ControlError as error:
        return {"error": str(error)}


def _log() -> str:
    units = ("--unit", "uavlinkd", "--unit", "uavlinkd@*", "--unit", "uavlinkd-relay")
    text = _run("journalctl", *units, "--lines", str(LOG_LINES), "--no-pager", "--output", "cat")
    return text or "the journal has no line of the units uavlinkd, uavlinkd@NAME and uavlinkd-relay"


def _run(*command: str) -> str:
    """The output of a command, or why it has no output."""
    try:
        done = subprocess.run(  # noqa: S603  the commands are fixed, and the paths are those of the user
            command,
            capture_output=True,
            text=True,
            errors="backslashreplace",
            timeout=COMMAND_TIMEOUT_S,
            check=False,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "COLUMNS": "80", "NO_COLOR": "1"},
        )
    except FileNotFoundError:
        return f"{command[0]} is not installed here\n"
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{command[0]} did not work: {error}\n"
    failed = f"{command[0]} ended with exit status {done.returncode}\n" if done.returncode else ""
    return done.stdout + done.stderr + failed


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="backslashreplace")
    except OSError as error:
        return f"cannot be read: {error.strerror}"


_CODE = re.compile(r"""(?:[^"'#]|"(?:\\.|[^"\\])*"|'[^']*')*""")
"""A line up to its comment."""


def _without_comments(path: Path) -> str:
    """The lines of a configuration. A comment may hold anything, so it is left out."""
    lines = [match[0].rstrip() for line in _read(path).split("\n") if (match := _CODE.match(line)) is not None]
    return "\n".join(filter(None, lines))


# The addresses of peers.

_ADDRESS = re.compile(r"""["']([^"']+)["'](?!\s*=)""")
"""A value in a list of addresses; not a key in quotes."""
_NETWORK = re.compile(r"""["']?network["']?\s*=\s*["'][^"']*["']""")
"""The network of an address, whose name is readable."""


def _addresses_of_peers(configs: Sequence[Path], statuses: Sequence[dict[str, Any]], log: str) -> Iterator[str]:
    for path in configs:
        for listed in re.findall(r"""(?ms)^\s*["']?addresses["']?\s*=\s*\[(.*?)\]\s*(?:#[^\n]*)?$""", _read(path)):
            yield from _ADDRESS.findall(_NETWORK.sub("", listed))
    for status in statuses:
        yield from (peer["path"] for peer in status.get("peers", {}).values() if peer["path"])
    for line in log.splitlines():
        event = None
        with suppress(ValueError):
            event = json.loads(line)
        if not isinstance(event, dict):
            continue
        named = event.get("addresses")
        values = [*(named if isinstance(named, list) else ()), event.get("path")] if "peer" in event else []
        if event.get("event") == "name_not_resolved":
            values.append(event.get("host"))
        yield from (value for value in values if isinstance(value, str))


# The command.


def write_report(options: argparse.Namespace, configs: Sequence[Path], sockets: Sequence[Path]) -> None:
    """Make the report, show it and write it. On a terminal the user confirms it; elsewhere it needs ``--yes``.

    Raises CommandError if the report was not written.
    """
    if not options.yes and not _is_terminal():
        raise CommandError("a person has to read the report before it is written: run it on a terminal, or add --yes")
    path = options.out or Path(time.strftime("uavlinkd-report-%Y%m%d-%H%M%S.txt"))
    text = make_report(configs, sockets)
    if not options.yes:
        print(text)
        answer = ""
        with suppress(EOFError):
            answer = input(f"Write this to {path}? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            raise CommandError("the report was not written")
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}") from None
    print(path)


def _is_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()
