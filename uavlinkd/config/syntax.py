"""Syntax errors of a configuration file: the parser's reason, with the line, the key and what to write.

No message repeats a value, because a value in the wrong place may be a secret. Of the keys, only those that a
configuration can have are repeated.
"""

from __future__ import annotations

import re
import tomllib
from contextlib import suppress
from pathlib import Path

from uavlinkd.config.keys import decode_key
from uavlinkd.config.model import Problem
from uavlinkd.config.problems import example_of

_AT = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_KEY = re.compile(r"""\s*["']?([A-Za-z0-9_-]{1,32})["']?(?![A-Za-z0-9_.'"+/-])""")
_NEXT = re.compile(r"\s*(?:$|\[|[A-Za-z0-9_-]+\s*=)")
"""The end of the file, a section, or a key."""
_MOST_LINES = 20
"""A longer value without an end is reported where the parser notices it. Each line costs a parse."""
_HINT = 'text is in straight quotation marks ("…"), true and false are in small letters, a comment begins with #'
_ONCE = "write a key once in its section, and for another peer or endpoint [[peer]] or [[endpoint]] above its keys"


def syntax_problem(path: Path, text: str, error: Exception) -> Problem:
    """The problem of a text that is not TOML."""
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
    if re.search(r"(?mi)^[ \t]*\[(UdpEndpoint|UartEndpoint|TcpEndpoint)\b", text):
        return "is a file of mavlink-router, and uavlinkd has its own format: start from configs/drone0.toml"
    try:
        decode_key(text)
    except ValueError:
        return None
    return "is a key file, not a configuration: give the .toml file to --config, and name the key file in it"
