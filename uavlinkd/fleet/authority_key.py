"""The authority's private key: its file, its passphrase, and its paper copy.

A passphrase is typed on the terminal or read from a file, never from the command line or the environment. Standard
input stays free for a request.
"""

from __future__ import annotations

import base64
import binascii
import getpass
import os
from collections.abc import Callable
from pathlib import Path

from uavlinkd.authority.enrolment import FleetError
from uavlinkd.config.keys import read_private_file
from uavlinkd.fleet.manifest import FleetFileError
from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.protocol.crypto import Secret, read_signing_key, sha256

AUTHORITY_FILE = "authority.pem"
_LIMIT = 4096
_CHECK_BYTES = 3  # of a paper copy, which so has 56 characters without padding
_GROUP = 4

LEAST_PASSPHRASE = 12
"""Characters of a new passphrase: who has a copy of the file can try millions a second."""

Passphrase = Callable[[str], Secret]  # returns the passphrase, given what it is for


def passphrase_from(file: Path | None, *, is_new: bool = False) -> Passphrase:
    """Where a passphrase comes from: the first line of a file, or the terminal, on which a new one is typed twice."""

    def ask(what: str) -> Secret:
        if file is not None:
            typed = read_private_file(file, _LIMIT).partition(b"\n")[0].rstrip(b"\r")
        else:
            typed = _typed(f"passphrase of {what}: ")
        if not typed:
            place = f"{file} is empty" if file is not None else "the passphrase is empty"
            advice = "choose four words or more, at random; without one, each copy of the file signs"
            raise FleetError(f"{place}: {advice if is_new else f'it must be that of {what}'}")
        if is_new and len(typed) < LEAST_PASSPHRASE:
            raise FleetError(
                f"the passphrase has fewer than {LEAST_PASSPHRASE} characters: choose four words or more, at random"
            )
        if is_new and file is None and _typed("once more: ") != typed:
            raise FleetError("the two passphrases differ: run the command again")
        return Secret(typed)

    return ask


def _typed(prompt: str) -> bytes:
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
        return getpass.getpass(prompt).encode()
    except (OSError, EOFError):  # getpass would read standard input, where a request may be
        raise FleetError(
            "there is no terminal to type the passphrase on: name a file, --passphrase-file FILE"
        ) from None


def load_key(file: Path, ask: Passphrase) -> Secret:
    """The key in a file. ``ask`` is called if it is encrypted."""
    pem = read_private_file(file, _LIMIT)
    is_encrypted = b"ENCRYPTED" in pem
    try:
        return read_signing_key(pem, ask(str(file)) if is_encrypted else None)
    except ValueError:
        if is_encrypted:
            reason = "the passphrase is wrong, or the file is damaged: run the command again with its passphrase"
        else:
            reason = "it is not a private key of Ed25519"
    raise FleetFileError(
        f"{file} cannot be used: {reason}, or move it away and write it from its paper copy: `uavlinkd fleet restore`"
    )


def paper_copy(private: Secret) -> str:
    """Two lines of seven groups of four characters, with a check."""
    key = private.reveal()
    text = base64.b32encode(key + sha256(b"uavlink paper" + key)[:_CHECK_BYTES]).decode().lower()
    groups = [text[at : at + _GROUP] for at in range(0, len(text), _GROUP)]
    return " ".join(groups[:7]) + "\n" + " ".join(groups[7:])


def read_paper(text: str) -> Secret:
    """The key of a paper copy, as it was typed."""
    try:
        data = base64.b32decode("".join(text.split()).upper())
    except (binascii.Error, ValueError):
        data = b""
    key, check = data[:KEY_BYTES], data[KEY_BYTES:]
    if len(data) != KEY_BYTES + _CHECK_BYTES or sha256(b"uavlink paper" + key)[:_CHECK_BYTES] != check:
        raise FleetError("a character of the paper copy is wrong or missing: it has 14 groups of a-z and 2-7")
    return Secret(key)
