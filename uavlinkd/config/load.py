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
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from uavlinkd.config import checks, key_rules, schema
from uavlinkd.config.advice import advice
from uavlinkd.config.build import build
from uavlinkd.config.keys import CREDENTIALS, KeyFileError, decode_key, find_secret_file, read_secret_file
from uavlinkd.config.model import Config, ConfigError, Problem
from uavlinkd.config.problems import Problems, Sections, Values, example_of
from uavlinkd.config.section import Section
from uavlinkd.config.tls_files import TlsFileError, find_tls_files
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.tasks import Threads

STATES = "STATE_DIRECTORY"
"""The environment variable in which systemd names the folder of a service that stays over restarts."""
_MAX_FILE_BYTES = 1 << 20
_THREAD = Threads(1, "configuration")
_AT = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_KEY = re.compile(r"""\s*["']?([A-Za-z0-9_-]{1,32})["']?(?![A-Za-z0-9_.'"+/-])""")
_NEXT = re.compile(r"\s*(?:$|\[|[A-Za-z0-9_-]+\s*=)")  # the end of the file, a section, or a key
_MOST_LINES = 20
"""A longer value without an end is reported where the parser notices it. Each line costs a parse."""
_HINT = 'text is in straight quotation marks ("…"), true and false are in small letters, a comment begins with #'
_ONCE = "write a key once in its section, and for another peer or endpoint [[peer]] or [[endpoint]] above its keys"


def load_config(path: Path, environ: Mapping[str, str]) -> Config:
    """The configuration in a file. Of ``environ``, only ``CREDENTIALS_DIRECTORY`` and ``STATE_DIRECTORY`` are used.

    Raises ConfigError with every problem of the file. An invalid value never becomes a default.
    """
    table = read_toml(path)
    problems = Problems(str(path))
    keys = {key: table[key] for key in table if key not in schema.SINGLE and key not in schema.REPEATED}
    sections: dict[str, Any] = {"top": problems.read(schema.FileSection, keys, "")}
    for key, model in schema.SINGLE.items():
        if key in table:
            sections[key] = problems.read(model, _table(problems, table, key), key)
        else:
            sections[key] = Values(key, {}, frozenset())
    for key, model in schema.REPEATED.items():
        sections[f"{key}s"] = _sections(problems, table, key, model)
    file = Sections(path.absolute().parent, frozenset(table), **sections)
    for contact in file.contacts:
        if (held := contact.get("certificate")) is not None:
            contact.valid["name"] = held.certificate.name
    for section, key in ((file.top, "private_key_file"), *((section, "psk_file") for section in file.others)):
        if (secret := _secret(problems, section, key, path, environ)) is not None:
            file.secrets[section.at(key)] = secret
    if (https := file.relay_server.get("https")) is not None:
        try:
            file.relay_server.valid["https"] = find_tls_files(https, file.folder, environ)
        except TlsFileError as error:
            problems.add(file.relay_server.at("https"), str(error))
    for place, message in checks.check(file):
        problems.add(place, message)
    problems.raise_any()
    states = environ.get(STATES, "").partition(":")[0]
    config = build(path, file, Path(states) if states else file.folder)
    warnings = (*key_rules.advice(config.private_key.reveal(), file.others), *advice(config))
    return replace(config, warnings=warnings)


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
    table = read_toml(path)
    problems = Problems(str(path))
    sections = (*schema.SINGLE, *schema.REPEATED)
    top = problems.read(schema.FileSection, {key: table[key] for key in table if key not in sections}, "")
    if "control_socket" in top.invalid:
        problems.raise_any()
    name = top.get("control_socket")
    return path.absolute().parent / name if name else None


def read_toml(path: Path) -> dict[str, Any]:
    """The file's tables. Raises ConfigError if the file cannot be read, or is not valid TOML."""
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise ConfigError((Problem(str(path), "", f"cannot be read: {reason}"),)) from None
    if len(content) > _MAX_FILE_BYTES:
        raise ConfigError((Problem(str(path), "", "is over a megabyte: name a configuration file"),))
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise ConfigError((at(path, line, column, "is not text in UTF-8: save the file as UTF-8"),)) from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError((syntax_problem(path, text, error),)) from None


def syntax_problem(path: Path, text: str, error: Exception) -> Problem:
    if message := _foreign_file(text):
        return Problem(str(path), "", message)
    match = _AT.fullmatch(str(error))
    if match is None:
        return Problem(str(path), "", "is not TOML that can be read: a number too long, or brackets too deep")
    lines = text.split("\n")
    line, column = (int(match[2]), int(match[3])) if match[2] else (len(lines), 1)
    # The reason without the names that it quotes, as in "Cannot declare ('a', 'b') twice".
    reason = re.sub(r"\s*(\(.*\)|'.{3,}'|\".*\")", "", match[1])
    if (start := _start_of_value(lines, line)) != line:
        line, column, reason = start, 1, f"{reason}: its value has no end"
    key = found[1] if (found := _KEY.match(lines[line - 1])) and example_of(found[1]) else ""
    if "twice" in reason or "verwrite" in reason or "Duplicate" in reason:
        remedy = _ONCE
    elif key:
        remedy = f"write {key} = {example_of(key)}; {_HINT}"
    else:
        remedy = f"write KEY = VALUE, [SECTION], or [[peer]] and [[endpoint]] for each of several; {_HINT}"
    return at(path, line, column, f"is not valid TOML here: {reason}: {remedy}", key)


def at(path: Path, line: int, column: int, message: str, key: str = "") -> Problem:
    """A problem at a place of the file, in the form that editors open."""
    return Problem(f"{path}:{line}:{column}", key, message)


def _start_of_value(lines: list[str], line: int) -> int:
    """The line of the key whose value has no end, which the parser notices at the next statement; else ``line``.

    The text before that key is valid.
    """
    for number in range(line, max(line - _MOST_LINES, 0), -1) if _NEXT.match(lines[line - 1]) else ():
        with suppress(ValueError, RecursionError):
            tomllib.loads("\n".join([*lines[: number - 1], ""]))
            return number
    return line


def _foreign_file(text: str) -> str | None:
    """The message for a file that is not a configuration of this software at all."""
    if re.search(r"(?m)^[ \t]*\[(Interface|Peer)\]", text):
        return (
            "is a WireGuard file (wg.conf), and uavlinkd has its own format: start from configs/drone0.toml. The keys"
            " have the same form: write PrivateKey to a file of mode 0600 and name it in private_key_file; write each"
            " PublicKey as public_key of a [[peer]]"
        )
    try:
        decode_key(text)
    except ValueError:
        return None
    return "is a key file, not a configuration: give the .toml file to --config, and name the key file in it"


def _table(problems: Problems, table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = table.get(key, {})
    if isinstance(value, dict):
        return value
    problems.add(key, f"must be a section: write [{key}], in single brackets, and its keys below")
    return {}


def _sections(problems: Problems, table: Mapping[str, Any], key: str, model: type[Section]) -> list[Values]:
    value = table.get(key, [])
    sections = value if isinstance(value, list) else [value]
    if key == "relay" and isinstance(value, bool):
        problems.add(key, "does not belong here: write it in [routing], or [[relay]] for a relay")
    elif sections is not value or not all(isinstance(section, dict) for section in sections):
        problems.add(key, f"must be a list of sections: write [[{key}]], in double brackets, for each")
    return [
        problems.read(model, section, f"{key}[{number}]")
        for number, section in enumerate(sections)
        if isinstance(section, dict)
    ]


def _secret(problems: Problems, section: Values, key: str, config: Path, environ: Mapping[str, str]) -> Secret | None:
    """The content of the key file that a section names, if it names one."""
    if (name := section.get(key)) is None:
        return None
    path, is_credential = find_secret_file(name, config.parent, environ)
    place = section.at(key)
    is_service = bool(environ.get(CREDENTIALS))
    if not os.path.lexists(path):
        credential = " and no systemd credential of that name" if is_service else ""
        remedy = _FOR_A_SERVICE if is_service else _how_to_get(key, path, config)
        problems.add(place, f"there is no file {path}{credential}: {remedy}")
        return None
    try:
        return read_secret_file(path, credential=is_credential)
    except KeyFileError as error:
        problems.add(place, f"{error}; {_FOR_A_SERVICE}" if is_service and not is_credential else str(error))
        return None


_FOR_A_SERVICE = (
    "put a service's keys into the folder that LoadCredential= names in its unit, owned by root and with mode 0600; "
    "the service reads them at its next start"
)


def _how_to_get(key: str, path: Path, config: Path) -> str:
    where = shlex.quote(str(path))
    if key == "psk_file":
        remedy = f"copy it from the peer, or make it on one of the two with `uavlinkd psk --out {where}`"
    else:
        remedy = f"make it with `uavlinkd keygen --out {where}`"
    # Folders where the systemd units look for key files that the configuration names without a folder.
    for folder in (config.parent / "keys", config.with_suffix("")):
        if folder.is_dir():
            option = f"--keys {shlex.quote(str(folder))}"
            return f"{remedy}; for a service's configuration, add `{option}` to `uavlinkd check`"
    return remedy
