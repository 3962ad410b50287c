"""Reading a configuration file: TOML, then each section and its key files, then the rules between sections.

No message repeats a value, because a value in the wrong place may be a secret. Of the keys, only those that a
configuration can have are repeated.
"""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from uavlinkd.config import checks
from uavlinkd.config.advice import advice
from uavlinkd.config.build import build
from uavlinkd.config.file import File, example_of
from uavlinkd.config.keys import CREDENTIALS, KeyFileError, find_secret_file, read_secret_file, reason_of
from uavlinkd.config.model import Config, ConfigError, Problem
from uavlinkd.config.schema import TOP
from uavlinkd.config.section import Values, read
from uavlinkd.config.tls_files import TlsFileError, find_tls_files
from uavlinkd.protocol.crypto import x25519_public_key
from uavlinkd.system.tasks import Threads

STATES = "STATE_DIRECTORY"
"""The environment variable in which systemd names the folder of a service that stays over restarts."""
_MAX_FILE_BYTES = 1 << 20
_THREAD = Threads(1, "configuration")
_AT = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_KEY = re.compile(r"""\s*["']?([A-Za-z0-9_-]{1,32})["']?(?![A-Za-z0-9_.'"+/-])""")
_HINT = 'text is in straight quotation marks ("…"), true and false are in small letters, a comment begins with #'
_ONCE = "write a key once in its section, and for another peer or endpoint [[peer]] or [[endpoint]] above its keys"


def load_config(path: Path, environ: Mapping[str, str]) -> Config:
    """The configuration in a file. Of ``environ``, only ``CREDENTIALS_DIRECTORY`` and ``STATE_DIRECTORY`` are used.

    Raises ConfigError with every problem of the file. An invalid value never becomes a default.
    """
    file = File(path, read_toml(path))
    for contact in file["contact"]:
        if (held := contact.get("certificate")) is not None:
            contact.valid["name"] = held.certificate.name
    secrets = ((section, "private_key_file") for section in (file.top, *file["stations"]))
    for section, key in (*secrets, *((peer, "psk_file") for peer in file["peer"])):
        _read_secret(file, section, key, environ)
    for endpoint in file["endpoint"]:
        _read_secret(file, endpoint, "signing_key_file", environ)
    if (private := file.top.get("private_key_file")) is not None:
        file.own_key = x25519_public_key(private.reveal())
    if (https := file.one("relay_server").get("https")) is not None:
        try:
            file.one("relay_server").valid["https"] = find_tls_files(https, file.folder, environ)
        except TlsFileError as error:
            file.add("relay_server.https", str(error))
    for place, message in checks.check(file):
        file.add(place, message)
    file.raise_any()
    states = environ.get(STATES, "").partition(":")[0]
    config = build(file, Path(states) if states else file.folder)
    return replace(config, warnings=tuple(advice(config)))


async def load_in_thread(path: Path, environ: Mapping[str, str]) -> Config:
    """Run :func:`load_config` in a worker thread: a slow disk or a named pipe must not stop the event loop.

    If the task is cancelled, the thread ends later and its result is discarded.
    Raises ConfigError with every problem of the file, or if no thread can be started now.
    """
    try:
        return await _THREAD.run(load_config, path, environ)
    except OSError as error:
        raise ConfigError((Problem(str(path), "", f"cannot be read now: {error.strerror}: try again"),)) from None


def load_control_socket(path: Path) -> Path | None:
    """The control socket of a configuration, if it has one. The other keys may be invalid or missing.

    Raises ConfigError if the file cannot be read, or its value for the socket is invalid.
    """
    key = "control_socket"
    values, problems = read({key: TOP[key]}, read_toml(path))
    if problems:
        raise ConfigError(tuple(Problem(str(path), *problem) for problem in problems))
    name = values.get(key)
    return path.absolute().parent / name if name else None


def read_toml(path: Path) -> dict[str, Any]:
    """The file's tables. Raises ConfigError if the file cannot be read, or is not valid TOML."""
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise ConfigError((Problem(str(path), "", f"cannot be read: {reason_of(error)}"),)) from None
    if len(content) > _MAX_FILE_BYTES:
        raise ConfigError((Problem(str(path), "", "is over a megabyte: name a configuration file"),))
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise ConfigError(
            (_problem_at(path, line, column, "is not text in UTF-8: save the file as UTF-8"),)
        ) from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError((syntax_problem(path, text, error),)) from None


def syntax_problem(path: Path, text: str, error: Exception) -> Problem:
    match = _AT.fullmatch(str(error))
    if match is None:
        return Problem(str(path), "", "is not TOML that can be read: a number too long, or brackets too deep")
    lines = text.split("\n")
    line, column = (int(match[2]), int(match[3])) if match[2] else (len(lines), 1)
    # The reason without the names that it quotes, as in "Cannot declare ('a', 'b') twice".
    reason = re.sub(r"\s*(\(.*\)|'.{3,}'|\".*\")", "", match[1])
    key = found[1] if (found := _KEY.match(lines[line - 1])) and example_of(found[1]) else ""
    if "twice" in reason or "verwrite" in reason or "Duplicate" in reason:
        remedy = _ONCE
    elif column == 1 and reason in ("Unclosed array", "Invalid value"):
        key, remedy = "", "close the brackets of the value above"
    elif key:
        remedy = f"write {key} = {example_of(key)}; {_HINT}"
    else:
        remedy = f"write KEY = VALUE, [SECTION], or [[peer]] and [[endpoint]] for each of several; {_HINT}"
    return _problem_at(path, line, column, f"is not valid TOML here: {reason}: {remedy}", key)


def _problem_at(path: Path, line: int, column: int, message: str, key: str = "") -> Problem:
    """A problem at a place of the file, in the form that editors open."""
    return Problem(f"{path}:{line}:{column}", key, message)


def _read_secret(file: File, section: Values, key: str, environ: Mapping[str, str]) -> None:
    """Put the content of a key file in the place of its name, or report why that cannot be done."""
    if (name := section.valid.pop(key, None)) is None:
        return
    path, is_credential = find_secret_file(name, file.folder, environ)
    try:
        section.valid[key] = read_secret_file(path, credential=is_credential)
    except KeyFileError as error:
        is_of_service = bool(environ.get(CREDENTIALS)) and not is_credential
        missing = "" if os.path.lexists(path) else _how_to_get(key, path, file.path)
        remedy = _FOR_A_SERVICE if is_of_service else missing
        file.add(section.at(key), f"{error}; {remedy}" if remedy else str(error))


_FOR_A_SERVICE = (
    "put a service's keys into the folder that LoadCredential= names in its unit, owned by root and with mode 0600; "
    "the service reads them at its next start"
)


def _how_to_get(key: str, path: Path, config: Path) -> str:
    for folder in (path.parent / config.stem, path.parent / "keys"):
        if os.path.lexists(folder / path.name):
            return f"the keys of its service are in {folder}: add --keys {shlex.quote(str(folder))}"
    where = shlex.quote(str(path))
    if key == "psk_file":
        return f"copy it from the peer, or make it on one of the two with `uavlinkd psk --out {where}`"
    if key == "signing_key_file":
        return "put it there, or delete this line, and run `uavlinkd signing setup` beside an autopilot without a key"
    remedy = f"make it with `uavlinkd keygen --out {where}`"
    return f"{remedy}, or name the folder of a service's keys with `uavlinkd check --keys DIR`"
