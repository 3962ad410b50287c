"""Builds receivers from MAVLink's C library for the test run."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import pymavlink.generator

from uavlinkd.mavlink.dialect_table import OTHER_EXTRAS

DIALECTS = ("minimal", "common", "ardupilotmega", "all")
LIBRARIES = ("2.0", "2.0-unknown", "2.0-other", "1.0")
"""The library of MAVLink 2: as it is, as it was before 2025, and with other definitions of some messages, public and
private ones. And the library of receivers that know MAVLink 1 only."""
PRIVATE_EXTRAS = {54321: 77, 150: 13}
"""CRC_EXTRA of messages in a private dialect."""
_SOURCE = Path(__file__).with_name("receiver.c")
_OF_MESSAGES = re.compile(r'#include "[^"]*mavlink_msg_\w+\.h"|#include "[^"]*testsuite.h"')
_FLAGS = ("-std=c11", "-O2", "-shared", "-fPIC", "-w", "-DMAVLINK_COMM_NUM_BUFFERS=1")


class BuildError(Exception):
    """A receiver cannot be built; the text is the reason."""


def compiler() -> str | None:
    """The C compiler's path, or None."""
    return shutil.which("cc")


@cache
def build_folder() -> Path:
    """The build folder of this process, which is removed at its end."""
    folder = tempfile.TemporaryDirectory(prefix="mavlink-receivers-")
    _kept.append(folder)
    return Path(folder.name)


_kept: list[tempfile.TemporaryDirectory[str]] = []


@cache
def build(dialect: str, library: str) -> Path:
    """The shared library of one dialect and version.

    Raises:
        BuildError: there is no compiler, or it fails.
    """
    cc = compiler()
    if cc is None:
        raise BuildError("a C compiler (cc) is missing")
    version = library.partition("-")[0]
    headers = _generate(dialect, version)
    target = build_folder() / f"{dialect}-{library}.so"
    others = {msgid: extras[0] for msgid, extras in OTHER_EXTRAS.items()} | PRIVATE_EXTRAS
    rows = ",".join(f"{{{msgid},{extra}}}" for msgid, extra in others.items())
    variants = {"unknown": ("-DACCEPTS_UNKNOWN",), "other": (f"-DOTHER_DEFINITIONS={{{rows}}}",)}
    variant = variants.get(library.partition("-")[2], ())
    command = (cc, *_FLAGS, *variant, f"-I{headers}", f"-I{headers / dialect}", str(_SOURCE), "-o", str(target))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(done.stderr)
    return target


@cache
def _generate(dialect: str, version: str) -> Path:
    """The headers of a dialect, generated from the definitions in pymavlink."""
    definitions = Path(pymavlink.generator.__file__).parent.parent / "dialects" / "v20" / f"{dialect}.xml"
    folder = build_folder() / f"{dialect}-{version}"
    command = (sys.executable, "-m", "pymavlink.tools.mavgen", "--lang=C", f"--wire-protocol={version}")
    done = subprocess.run(
        (*command, "--no-validate", f"--output={folder}", str(definitions)),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise BuildError(done.stdout + done.stderr)
    for header in folder.glob("*/*.h"):  # the parser needs the tables of messages, not the code for each of them
        if not header.name.startswith("mavlink_msg_"):
            header.write_text(_OF_MESSAGES.sub("", header.read_text(encoding="utf-8")), encoding="utf-8")
    return folder
