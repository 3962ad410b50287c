"""The end of a command: its exit status, and text for a terminal that must not act as a control sequence."""

from __future__ import annotations

OK, FAILED, WRONG = 0, 1, 2


class CommandError(Exception):
    """Ends a command. The message is for the user."""

    status = FAILED


class UsageError(CommandError):
    """The command line or a configuration is wrong."""

    status = WRONG


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
