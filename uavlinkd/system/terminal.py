"""The end of a command: its exit status, and text for a terminal that must not act as a control sequence."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager

OK, FAILED, WRONG = 0, 1, 2


class CommandError(Exception):
    """Ends a command. The message is for the user."""

    status = FAILED


class UsageError(CommandError):
    """The command line or a configuration is wrong."""

    status = WRONG


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add the option ``--json``, which each command that shows facts has."""
    parser.add_argument("--json", action="store_true", help="print everything as JSON, one object a line")


@contextmanager
def without_echo() -> Iterator[None]:
    """Show nothing that is typed, and discard it at the end: a secret may be typed before its prompt is there."""
    terminal = -1
    try:
        import termios  # noqa: PLC0415  not on Windows

        terminal = os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY)
        if os.tcgetpgrp(terminal) != os.getpgrp():  # a background process would be stopped
            raise OSError
        before = termios.tcgetattr(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, [*before[:3], before[3] & ~termios.ECHO, *before[4:]])
    except (ImportError, OSError):
        yield
        return
    try:
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSAFLUSH, before)
        os.close(terminal)


def printable(text: str, *, keep: str = "") -> str:
    r"""Write each control or invisible character as an escape sequence such as ``\x1b``, except those in ``keep``.

    Names, paths and keys in messages may come from a file or an argument that an attacker wrote.
    """
    return "".join(
        character
        if character.isprintable() or character in keep
        else character.encode("unicode_escape", "backslashreplace").decode("ascii")
        for character in text
    )
