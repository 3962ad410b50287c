"""Reading a configuration in a process of its own, which ends when it is read.

Checking a file takes pydantic: 12 MB and a fifth of a second, for a moment at the start. A daemon beside an autopilot
for hours should not carry that, so another process checks, and hands over the result through a pipe. While it does,
the daemon imports what it needs itself.
"""

from __future__ import annotations

import io
import os
import pickle
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from uavlinkd import __version__
from uavlinkd.checker import checker_command
from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.model import Config
from uavlinkd.core.crypto import Secret
from uavlinkd.system.core_dumps import forbid_core_dumps


def result_of(process: subprocess.Popen[bytes], path: Path) -> Config:
    """Wait for what a process of :func:`uavlinkd.checker.start_checking` finds.

    Raises:
        ConfigError: every problem of the file.
    """
    answer, _ = process.communicate()
    return _taken_over(answer, path)


async def read_config(path: Path) -> Config:
    """The same in a running event loop, which goes on meanwhile.

    Raises:
        ConfigError: every problem of the file.
    """
    import asyncio  # noqa: PLC0415  not in the process that reads: it ends the sooner

    try:
        process = await asyncio.create_subprocess_exec(
            *checker_command(path), stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE
        )
    except OSError as error:  # no descriptor, or no room for another process
        raise ConfigError((Problem(str(path), "", f"cannot be read now: {error.strerror}: try again"),)) from None
    try:
        answer, _ = await process.communicate()
    finally:
        if process.returncode is None:  # the daemon was told to end: nobody waits for the file any more
            with suppress(ProcessLookupError):
                process.kill()
    return _taken_over(answer, path)


def handed_over(result: Config | tuple[Problem, ...]) -> bytes:
    """What goes through the pipe: the configuration with its secrets, or what is wrong with it."""
    stream = io.BytesIO()
    _Pickler(stream).dump((__version__, result))
    return stream.getvalue()


def _taken_over(answer: bytes, path: Path) -> Config:
    try:
        version, result = pickle.loads(answer)  # noqa: S301  from our own child, by a pipe that nobody else has
    except Exception:  # cut short, or of another version's classes
        version = None
    if version != __version__:  # one was installed since this process began
        why = "could not be read: the process that reads it ended early, or is of another version than this one"
        result = (Problem(str(path), "", why),)
    if isinstance(result, Config):
        return result
    raise ConfigError(result)


class _Pickler(pickle.Pickler):
    """Takes along what refuses to be pickled by accident: secrets, and views of dictionaries."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Secret):
            return Secret, (obj.reveal(),)
        if isinstance(obj, MappingProxyType):
            return _view, (dict(obj),)
        return NotImplemented


def _view(contents: dict[str, object]) -> MappingProxyType[str, object]:
    """The type itself has no name that could be looked up."""
    return MappingProxyType(contents)


def main() -> NoReturn:
    """``python -m uavlinkd.config FILE``: what :mod:`uavlinkd.checker` starts."""
    forbid_core_dumps()
    from uavlinkd.config.load import load_config  # noqa: PLC0415

    result: Config | tuple[Problem, ...]
    try:
        result = load_config(Path(sys.argv[1]), os.environ)
    except ConfigError as error:
        result = error.problems
    with suppress(BrokenPipeError), sys.stdout.buffer as pipe:  # broken: the daemon was told to end meanwhile
        pipe.write(handed_over(result))
    sys.exit(0)
