"""Syntax errors of a configuration file: the parser's error becomes the likely slip, with its line, key and remedy.

No message repeats a value, because a value in the wrong place may be a secret. Of the keys, only those that a
configuration can have are repeated.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from uavlinkd.config.errors import Problem
from uavlinkd.config.keys import decode_key
from uavlinkd.config.problems import example_of

_AT = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_STATEMENT = re.compile(r"""\s*["']?([A-Za-z0-9_-]{1,32})["']?[ \t]*(:=|==|=|:|)[ \t]*(.*)""", re.DOTALL)
_HEADER = re.compile(r"\s*(\[{1,2})([^\[\]]*)(\]{0,2})(.*)", re.DOTALL)
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'')
_REPEATED = ("peer", "endpoint")
_SECTIONS = ("link", "log", "routing", "metrics", "recording")
_TYPOGRAPHIC = "“”„‟«»‘’‚‛′″"  # noqa: RUF001  the quotation marks of word processors and web pages
_SPACES = "\u00a0\u2007\u202f\u200b\u2060\ufeff\u3000"
_WORDS = {"true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false"}
_LONGEST_LINE = 4096
"""No person writes a longer line."""
_TEXT = '"…"'
_HINT = 'text is in quotation marks ("…"), true and false are in small letters'


class Slip(NamedTuple):
    """A likely mistake: its line, the key in this line if a configuration has it, and the message."""

    line: int
    key: str
    message: str


def syntax_problem(path: Path, text: str, error: Exception) -> Problem:
    """The problem of a text that is not TOML."""
    if message := _foreign_file(text):
        return Problem(str(path), "", message)
    match = _AT.fullmatch(str(error))
    if match is None:
        return Problem(str(path), "", "is not TOML that can be read: a number too long, or brackets too deep")
    lines = text.split("\n")
    line, column = (int(match[2]), int(match[3])) if match[2] else (len(lines), len(lines[-1]) + 1)
    reason = _without_names(match[1])
    slip = next(_slips(lines, line, column, match[1]), None)
    if slip is None:
        hint = f"; {_HINT}" if "nvalid value" in reason else ""
        return at(path, line, column, f"is not valid TOML here: {reason}{hint}")
    same_line = slip.line == line
    return Problem(f"{path}:{slip.line}:{column if same_line else 1}", slip.key, slip.message)


def at(path: Path, line: int, column: int, message: str) -> Problem:
    """A problem at a place of the file, in the form that editors open."""
    return Problem(f"{path}:{line}:{column}", "", message)


def _without_names(message: str) -> str:
    """``Cannot declare ('a', 'b') twice`` without the keys that it quotes; the line number shows which they are."""
    return re.sub(r"\s*(\(.*\)|'.*'|\".*\")", "", message)


def _foreign_file(text: str) -> str | None:
    """The message for a file that is not a configuration of this software at all."""
    if re.search(r"(?m)^[ \t]*\[Interface\]", text) or (
        re.search(r"(?m)^[ \t]*\[Peer\]", text)
        and re.search(r"(?m)^[ \t]*(PublicKey|AllowedIPs|PresharedKey)[ \t]*=", text)
    ):
        return (
            "is a WireGuard file (wg.conf), and uavlinkd has its own format: start from configs/drone0.toml. The keys"
            " have the same form: write PrivateKey to a file of mode 0600 and name it in private_key_file; write each"
            " PublicKey as public_key of a [[peer]], and the host of Endpoint, with uavlinkd's port, in addresses"
        )
    if re.search(r"(?mi)^[ \t]*\[(UdpEndpoint|UartEndpoint|TcpEndpoint)\b", text):
        return (
            "is a file of mavlink-router, and uavlinkd has a format of its own: start from configs/drone0.toml, with"
            ' an [[endpoint]] such as url = "serial:/dev/ttyACM0:57600" or url = "udpin:127.0.0.1:14550"'
        )
    if text.lstrip().startswith("{"):
        return "is JSON, and the configuration is TOML: start from configs/drone0.toml"
    try:
        decode_key(text)
    except ValueError:
        return None
    return "is a key file, not a configuration: give the .toml file to --config, and name the key file in it"


def _slips(lines: list[str], line: int, column: int, reason: str) -> Iterator[Slip]:
    """The likely mistakes, the surest first."""
    text = lines[line - 1].rstrip("\r")
    if len(text) > _LONGEST_LINE:
        return
    # The parser notices an open list or table at the next statement.
    if reason.startswith(("Unclosed", "Invalid value")):
        is_statement = re.match(r"\s*[A-Za-z0-9_-]+\s*=", text) and column == len(text) - len(text.lstrip()) + 1
        start = _start_of_value(lines, line)
        if start != line and (is_statement or text.lstrip().startswith("[") or not text.strip()):
            yield from _unclosed(start, lines[start - 1])
    if reason.startswith("Unterminated") or (reason.startswith("Expected") and not text.strip()):
        start = next((n for n, other in enumerate(lines, 1) if len(re.split("\"{3}|'{3}", other)) == 2), 0)
        if start:
            yield Slip(
                start, _key(lines[start - 1]), f'has text in """ that is not closed: write {_TEXT} on one line'
            )
        start = next((n for n, other in enumerate(lines, 1) if _without_comment(other).count("'") % 2), 0)
        if start:
            yield from _quotation(
                start, _key(lines[start - 1]), _without_comment(lines[start - 1]).partition("=")[2].strip(), reason
            )
    code = _without_comment(text)
    yield from _characters(line, code)
    yield from _header(lines, line, code, reason)
    yield from _comment(line, code)
    yield from _value(lines, line, code, reason)


def _start_of_value(lines: list[str], line: int) -> int:
    """The line of the statement before, or of this one."""
    for number in range(line - 1, 0, -1):
        if _without_comment(lines[number - 1]).strip():
            if re.match(r"\s*[A-Za-z0-9_-]+\s*=", lines[number - 1]):
                return number
            if lines[number - 1].lstrip().startswith("["):
                break
    return line


def _unclosed(number: int, text: str) -> Iterator[Slip]:
    code, key = _without_comment(text), _key(text)
    if "{" in _STRING.sub("", code):
        yield Slip(number, key, "has no closing brace: write { NAME = NUMBER } on one line")
    else:
        yield Slip(number, key, f"has a list without its closing bracket: {_write(key, '[…]')}")


def _characters(line: int, code: str) -> Iterator[Slip]:
    bare = _STRING.sub("", code)
    if any(mark in bare for mark in _TYPOGRAPHIC):
        yield Slip(line, _key(code), 'has typographic quotation marks: write straight ones, "…"')
    if any(space in bare for space in _SPACES):
        yield Slip(line, _key(code), "has a space of another kind, as web pages do: delete it and type a plain space")


def _header(lines: list[str], line: int, code: str, reason: str) -> Iterator[Slip]:
    match = _HEADER.fullmatch(code)
    if match is None or not code.lstrip().startswith("["):
        return
    opening, name, closing, rest = (group.strip() for group in match.groups())
    top = name.partition(".")[0]
    is_dotted = "." in name  # what stands after the dot may be a secret
    if top in _REPEATED:
        right = f"[{top}.KEY]" if is_dotted else f"[[{top}]]"
    else:
        right = f"[{top}]" if top in _SECTIONS else ""
    if len(opening) != len(closing):
        yield Slip(line, "", f"has brackets that do not match: write {right or '[section] or [[section]]'}")
    elif rest:
        yield Slip(
            line, "", f"has text after the section's name: write {right or 'the section'} on a line of its own"
        )
    elif right == f"[[{top}]]" and ("twice" in reason or "overwrite" in reason.lower()):
        single = next((n for n, text in enumerate(lines, 1) if re.match(rf"\s*\[\s*{top}\s*\](?!\])", text)), line)
        yield Slip(single, "", f"is one section of several: write {right}, in double brackets, for each {top}")
    elif right and not is_dotted and "twice" in reason:
        first = next((n for n, text in enumerate(lines, 1) if _without_comment(text).strip() == right), line)
        yield Slip(line, "", f"is a second {right}: write its keys below the first, in line {first}")


def _comment(line: int, code: str) -> Iterator[Slip]:
    if code.lstrip().startswith((";", "//", "--", "/*")):
        yield Slip(line, "", "begins a comment with another mark: a comment begins with #")


def _value(lines: list[str], line: int, code: str, reason: str) -> Iterator[Slip]:
    match = _STATEMENT.fullmatch(code)
    if match is None:
        return
    written, sign, value = match[1], match[2], match[3].strip()
    if value.startswith("."):  # a dotted key
        return
    key = written if example_of(written) else ""
    if sign == "" and code.lstrip().startswith("- "):
        yield Slip(line, "", "is a list as in YAML: write [[peer]] or [[endpoint]] above each section's keys")
    if sign == "":
        yield Slip(line, key, f"has no = after the key: {_write(key)}")
    if sign in (":", ":="):
        yield Slip(line, key, f"has a colon where TOML has =: {_write(key)}")
    if sign == "==":
        yield Slip(line, key, f"has == in place of =: {_write(key)}")
    if not value:
        yield Slip(line, key, f"has no value: {_write(key)}")
    if "overwrite" in reason.lower() or "twice" in reason:
        yield from _repeated(lines, line, written, key)
    yield from _quotation(line, key, value, reason)
    yield from _unquoted(line, key, value)
    yield from _after_value(line, key, value, reason)


def _repeated(lines: list[str], line: int, written: str, key: str) -> Iterator[Slip]:
    first = None
    for number in range(line - 1, 0, -1):
        if lines[number - 1].lstrip().startswith("["):
            break
        if re.match(rf"""\s*["']?{re.escape(written)}["']?\s*=""", lines[number - 1]):
            first = number
    where = f", first in line {first}" if first else ""
    yield Slip(
        line,
        key,
        f"is written twice in this section{where}: delete one; for another peer or endpoint, write [[peer]] or"
        " [[endpoint]] above its keys",
    )


def _quotation(line: int, key: str, value: str, reason: str) -> Iterator[Slip]:
    bare = _STRING.sub("", value)
    if "\\" in value and ("scape" in reason or "hex" in reason or "backslash" in reason):
        yield Slip(line, key, "has a backslash in its text: write /, or put the text in single quotation marks, '…'")
    if bare.count('"') + bare.count("'") == 0:
        return
    if value[0] not in "\"'[{":
        yield Slip(line, key, f"has no opening quotation mark: {_write(key)}")
    if bare.count("'") and bare.count('"'):
        yield Slip(line, key, f"has two kinds of quotation marks around its text: {_write(key)}")
    yield Slip(line, key, f"has no closing quotation mark: {_write(key)}")


def _unquoted(line: int, key: str, value: str) -> Iterator[Slip]:
    bare = _STRING.sub('""', value)
    if word := _WORDS.get(bare.lower()):
        yield Slip(line, key, f"is true or false in small letters, without quotation marks: {_write(key, word)}")
    items = bare.strip("[] \t")
    if bare.startswith("[") and bare.count("[") > bare.count("]"):
        yield Slip(line, key, f"has a list without its closing bracket: {_write(key, '[…]')}")
    if bare.count("]") > bare.count("["):
        yield Slip(line, key, f"has a list without its opening bracket: {_write(key, '[…]')}")
    if bare.startswith("{") and "}" not in bare:
        yield Slip(line, key, "has no closing brace: write { NAME = NUMBER } on one line")
    if bare.startswith("{") and re.search(r"[A-Za-z0-9_\"]\s*:", bare):
        yield Slip(line, key, "has a colon in its table where TOML has =: write { NAME = NUMBER }")
    if re.search(r"(?:^|,)\s*\d+\s*-\s*\d+", items) and bare.startswith("["):
        yield Slip(line, key, 'has a range without quotation marks: write it as text, such as "1-10"')
    if re.search(r'""\s+""', bare):
        yield Slip(line, key, 'has items without a comma between them: write [1, 2] or ["…", "…"]')
    if re.search(r"(?:^|[\[,])\s*0\d", bare):
        yield Slip(line, key, "has a number that begins with 0: write it without the 0")
    if re.search(r"(?:^|[\[,])\s*(?:[A-Za-z/~.:]|\d+\.\d+\.|\d+:|[0-9a-f]*::)", bare):
        yield Slip(line, key, f"has text without quotation marks: {_write(key)}")


def _after_value(line: int, key: str, value: str, reason: str) -> Iterator[Slip]:
    if not reason.startswith("Expected newline"):
        return
    bare = _STRING.sub('""', value)
    if bare.rstrip().endswith((",", ";")):
        yield Slip(line, key, "ends in a comma or semicolon: delete it")
    elif re.fullmatch(r"[\d_.]+\s*[A-Za-z/%]+", bare):
        yield Slip(line, key, "has a unit after its number: write the number alone, the key's name has the unit")
    elif re.fullmatch(r"\d+,\d+", bare):
        yield Slip(line, key, "has a decimal comma: write a decimal point")
    elif "=" in bare:
        yield Slip(line, key, "has two keys in one line: write each on a line of its own")
    else:
        yield Slip(line, key, "has text after its value: delete it, or begin a comment with #")


def _without_comment(text: str) -> str:
    """A line without its comment. A # in a complete string is part of it."""
    position = 0
    for match in _STRING.finditer(text):
        hash_at = text.find("#", position, match.start())
        if hash_at >= 0:
            return text[:hash_at]
        position = match.end()
    hash_at = text.find("#", position)
    return text if hash_at < 0 else text[:hash_at]


def _key(text: str) -> str:
    match = _STATEMENT.match(text)
    return match[1] if match and example_of(match[1]) else ""


def _write(key: str, value: str | None = None) -> str:
    """What to write, with an example in place of the value, which may be a secret."""
    if not key:
        return f"write KEY = {value or _TEXT}"
    example = example_of(key) or ""
    if value is None or (value == "[…]" and example.startswith("[")):
        value = example
    return f"write {key} = {value}"
