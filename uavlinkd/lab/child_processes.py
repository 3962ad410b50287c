"""Child processes and folders with keys that do not outlive the process that made them, however it ends."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_BOUND = """\
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
if ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0):
    sys.exit("prctl(PR_SET_PDEATHSIG) failed")
if os.getppid() != int(sys.argv[1]):
    sys.exit("the parent has ended")
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
try:
    os.execvp(sys.argv[2], sys.argv[2:])
except OSError as error:
    sys.exit(f"{sys.argv[2]}: {error.strerror}")
"""
"""Asks the kernel for the signal, and becomes the command. The ``preexec_fn`` of :mod:`subprocess` may deadlock in a
process with threads."""

_REMOVE = """\
import os, shutil, signal, sys, time
for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
    signal.signal(number, signal.SIG_IGN)
print(flush=True)
sys.stdin.buffer.read()
for _ in range(100):
    shutil.rmtree(sys.argv[1], ignore_errors=True)
    if not os.path.lexists(sys.argv[1]):
        break
    time.sleep(0.1)
"""
"""Removes a folder at the end of its standard input. Processes that are just ending may still create files in it."""


def end_with_parent(*command: str) -> tuple[str, ...]:
    """Return a command that runs ``command`` as a child of this process. The kernel kills it when this process ends.

    The child is killed (SIGKILL) when the thread that started it ends: start it in a thread that lives as long as it.
    The process IDs before and after the call of ``command`` are the same.
    """
    return (sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid()), *command)


async def stop_child(process: asyncio.subprocess.Process, number: signal.Signals, patience_s: float) -> None:
    """Stop a process: first with a signal, then by killing it."""
    if process.returncode is not None:
        return
    process.send_signal(number)
    with suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), patience_s)
    if process.returncode is None:
        process.kill()
        await process.wait()


@contextmanager
def private_folder(prefix: str) -> Iterator[Path]:
    """A temporary folder for keys. A child process removes it if this process is killed.

    Only if that process is killed too, or the machine stops, does the folder remain.
    """
    with tempfile.TemporaryDirectory(prefix=prefix) as folder:
        remover = subprocess.Popen(  # noqa: S603  constant command
            (sys.executable, "-I", "-S", "-c", _REMOVE, folder),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd="/",
            start_new_session=True,  # the terminal's signals do not reach it
        )
        assert remover.stdin is not None
        assert remover.stdout is not None
        try:
            remover.stdout.readline()
            yield Path(folder)
        finally:
            remover.stdin.close()
            remover.wait()
            remover.stdout.close()
