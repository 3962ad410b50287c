"""Receivers made of MAVLink's C library: which frames each accepts in a stream, from any start and after losses."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pymavlink.generator

from uavlinkd.mavlink.dialect import OTHER_EXTRAS

DIALECTS = ("minimal", "common", "ardupilotmega", "all")
PRIVATE_EXTRAS = {54321: 77, 150: 13}
"""CRC_EXTRA of messages in a private dialect."""
_SOURCE = Path(__file__).with_name("receiver.c")
_OF_MESSAGES = re.compile(r'#include "[^"]*mavlink_msg_\w+\.h"|#include "[^"]*testsuite.h"')
_FLAGS = ("-std=c11", "-O2", "-shared", "-fPIC", "-w", "-DMAVLINK_COMM_NUM_BUFFERS=1")
KEY = bytes(range(32))
"""The signing key of receivers that check signatures."""
EVERY_LOSS = -1
_ROOM = 4096
_STATES = 32

# The parser's states, by the library's numbers.
STATES_2 = (
    *("UNINIT", "IDLE", "GOT_STX", "GOT_LENGTH", "GOT_INCOMPAT_FLAGS", "GOT_COMPAT_FLAGS", "GOT_SEQ", "GOT_SYSID"),
    *("GOT_COMPID", "GOT_MSGID1", "GOT_MSGID2", "GOT_MSGID3", "GOT_PAYLOAD", "GOT_CRC1", "GOT_BAD_CRC1"),
    *("SIGNATURE_WAIT", "SIGNATURE_WAIT_BAD_CRC"),
)
STATES_1 = (
    *("UNINIT", "IDLE", "GOT_STX", "GOT_SEQ", "GOT_LENGTH", "GOT_SYSID", "GOT_COMPID", "GOT_MSGID", "GOT_PAYLOAD"),
    *("GOT_CRC1", "GOT_BAD_CRC1"),
)


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
    """The shared library of one dialect and version. Raises BuildError if there is no compiler, or it fails."""
    others = {msgid: extras[0] for msgid, extras in OTHER_EXTRAS.items()} | PRIVATE_EXTRAS
    rows = ",".join(f"{{{msgid},{extra}}}" for msgid, extra in others.items())
    variants = {"unknown": ("-DACCEPTS_UNKNOWN",), "other": (f"-DOTHER_DEFINITIONS={{{rows}}}",)}
    version, _, variant = library.partition("-")
    return compile_shared(_SOURCE, dialect, version, *variants.get(variant, ()))


def compile_shared(source: Path, dialect: str, version: str, *flags: str) -> Path:
    """The shared library of a source beside the headers of a dialect. Raises BuildError."""
    cc = compiler()
    if cc is None:
        raise BuildError("a C compiler (cc) is missing")
    headers = _generate(dialect, version)
    handle, target = tempfile.mkstemp(suffix=".so", prefix=f"{source.stem}-{dialect}-", dir=build_folder())
    os.close(handle)
    command = (cc, *_FLAGS, *flags, f"-I{headers}", f"-I{headers / dialect}", str(source), "-o", target)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(done.stderr)
    return Path(target)


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


class Options(NamedTuple):
    """How a receiver uses the library."""

    resumes: bool = True
    """``mavlink_parse_char``, which resumes at the last byte of a rejected frame; else ``mavlink_frame_char``."""
    mavlink1: bool = True
    """Whether 0xFE starts a frame."""
    signs: bool = False
    """Whether it checks signatures, by :data:`KEY`; of unsigned frames it then accepts only RADIO_STATUS."""
    takes_unsigned: bool = False
    """With ``signs``: accepts every unsigned frame."""

    @property
    def bits(self) -> int:
        """The form for receiver.c."""
        return self.resumes | (not self.mavlink1) << 1 | self.signs << 2 | self.takes_unsigned << 3


_PLAIN = Options()


class Accepted(NamedTuple):
    """A frame that a receiver accepted and that was not delivered as such."""

    stream: int  # which of the streams
    start: int  # offset in it, before anything was lost
    raw: bytes  # as the receiver read it, from its own start byte
    lost_at: int  # -1: nothing was lost
    lost: int
    spans: bool  # whether the loss is inside it, or inside the rejected frame whose last byte it begins with


class _Accepted(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_int32) for name in ("stream", "start", "length", "lost_at", "lost", "mavlink1", "spans")
    ]


class _Counts(ctypes.Structure):
    _fields_ = [
        ("parses", ctypes.c_int64),
        ("accepted", ctypes.c_int64),
        ("spanning", ctypes.c_int64),
        ("losses", ctypes.c_int64),
        ("steps", ctypes.c_int64 * _STATES * _STATES),
        ("framing", ctypes.c_int64 * 4),
    ]


class Delivery(NamedTuple):
    """The bytes that a client read, and the frames in them: the offsets of each one's first byte and of its end."""

    stream: bytes
    frames: Sequence[tuple[int, int]]


class Batch:
    """Deliveries in the form for receiver.c."""

    def __init__(self, deliveries: Sequence[Delivery]) -> None:
        self.count = len(deliveries)
        self.data = b"".join(delivery.stream for delivery in deliveries)
        begins = [0]
        for delivery in deliveries:
            begins.append(begins[-1] + len(delivery.stream))
        self.begins = (ctypes.c_int32 * len(begins))(*begins)
        self.frame_end = (ctypes.c_int32 * (len(self.data) + 1))()
        for begin, delivery in zip(begins, deliveries, strict=False):
            for start, end in delivery.frames:
                self.frame_end[begin + start] = end


@dataclass
class Receiver:
    """One dialect, one version of the library, one way to use it."""

    dialect: str
    library: str
    options: Options = _PLAIN
    counts: _Counts = field(default_factory=_Counts, repr=False)

    @property
    def name(self) -> str:
        """A name for people: ``common parse_char``, with the other options."""
        parts = [self.dialect, "parse_char" if self.options.resumes else "frame_char_buffer"]
        parts += ["library of MAVLink 1"] if self.library == "1.0" else []
        parts += ["CRC_EXTRA 0 for unknown messages"] if self.library == "2.0-unknown" else []
        parts += ["other definitions"] if self.library == "2.0-other" else []
        parts += [] if self.options.mavlink1 else ["MAVLink 2 only"]
        parts += (
            (["signing, unsigned too"] if self.options.takes_unsigned else ["signing"]) if self.options.signs else []
        )
        return ", ".join(parts)

    def judge(
        self, batch: Batch, *, every_offset: bool = False, losses: int = 0, seed: int = 1
    ) -> tuple[int, list[Accepted]]:
        """How many frames beyond the delivered ones it accepts, and the first few thousand of them.

        ``losses``: random losses for each stream; EVERY_LOSS: every loss at every offset; ``-1 - n``: every loss of
        ``n`` bytes.
        """
        record = (_Accepted * _ROOM)()
        total = _load(self.dialect, self.library).judge(
            batch.data,
            batch.begins,
            batch.count,
            batch.frame_end,
            self.options.bits,
            int(every_offset),
            losses,
            ctypes.c_uint64(seed or 1),
            record,
            _ROOM,
            ctypes.byref(self.counts),
        )
        return total, [self._read(batch, record[k]) for k in range(min(total, _ROOM))]

    def accepts(self, stream: bytes, frames: Sequence[tuple[int, int]] = ()) -> list[bytes]:
        """The frames that it accepts when it reads a stream from its start, without those that were delivered."""
        return [accepted.raw for accepted in self.judge(Batch([Delivery(stream, frames)]))[1]]

    def _read(self, batch: Batch, result: _Accepted) -> Accepted:
        begin = batch.begins[result.stream] + result.start
        raw = batch.data[begin : begin + result.length]
        if result.start < result.lost_at < result.start + result.length:
            lost_at = batch.begins[result.stream] + result.lost_at
            raw = batch.data[begin:lost_at] + batch.data[lost_at + result.lost :]
            raw = raw[: result.length]
        if result.mavlink1 and raw[0] == 0xFD:
            raw = b"\xfe" + raw[1:]
        return Accepted(result.stream, result.start, raw, result.lost_at, result.lost, bool(result.spans))

    @property
    def steps(self) -> dict[tuple[str, str], int]:
        """The number of transitions of the parser from one state to another."""
        names = STATES_1 if self.library == "1.0" else STATES_2
        rows = self.counts.steps
        return {
            (before, after): int(rows[i][k])
            for i, before in enumerate(names)
            for k, after in enumerate(names)
            if rows[i][k]
        }


@cache
def _load(dialect: str, library: str) -> ctypes.CDLL:
    loaded = ctypes.CDLL(str(build(dialect, library)))
    loaded.judge.restype = ctypes.c_int32
    return loaded


def all_receivers(dialects: Sequence[str] = DIALECTS) -> list[Receiver]:
    """Every receiver: each dialect, parser and version, with and without MAVLink 1 and signing."""
    signing = (Options(), Options(signs=True), Options(signs=True, takes_unsigned=True))
    of_library_2 = [
        kind._replace(resumes=resumes, mavlink1=mavlink1)
        for kind in signing
        for resumes in (True, False)
        for mavlink1 in (True, False)
    ]
    either = [Options(resumes=True), Options(resumes=False)]
    kinds = [("2.0", dialect) for dialect in of_library_2]
    kinds += [(library, option) for library in ("2.0-unknown", "2.0-other", "1.0") for option in either]
    return [Receiver(dialect, library, options) for dialect in dialects for library, options in kinds]
