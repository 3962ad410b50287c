"""Text for a terminal: text from a file or an attacker must not act as a control sequence."""

from __future__ import annotations


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
