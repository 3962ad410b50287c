"""What a test leaves in its process: tests/conftest.py compares the process before and after each test.

A test may import modules, and close what was open before. All else must be as before. If a test shares a fixture with
the other tests of its module, it may open files, processes, threads and namespaces for them: the end of the module is
compared with its beginning.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import logging
import os
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from time import monotonic
from types import ModuleType
from typing import Any, Final

import structlog
import uvloop

from tests.waiting import note_pauses
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.protocol.crypto import x25519_public_key

State = Mapping[str, Mapping[Any, Any]]
"""By kind and name."""

_PR_GET_DUMPABLE: Final = 3
_LIMITS: Final = {name: value for name, value in vars(resource).items() if name.startswith("RLIMIT_")}
_SIGNALS: Final = sorted(number for number in signal.valid_signals() if number < signal.SIGRTMIN)
_OF_PYTEST: Final = ("PYTEST_", "COV_CORE_")
"""Environment variables that pytest and its plugins change themselves begin so."""
_DEFAULT_LOGGER: Final = (logging.NOTSET, (), (), False, True)
END_S: Final = 10.0
"""A thread or task may end so long after the test."""
_ABSENT: Final = object()
_libc: Final = ctypes.CDLL(None)


def _structlog() -> dict[str, Any]:
    config = structlog.get_config()
    return {**config, "processors": list(config["processors"])}  # `capture_logs` changes the list itself


def _loggers() -> dict[str, Any]:
    """Settings that differ from the default. A library may add a handler that does nothing."""
    loggers: dict[str, Any] = {"of all": logging.root.manager.disable}
    for name, logger in [("root", logging.root), *logging.root.manager.loggerDict.items()]:
        if isinstance(logger, logging.Logger):
            handlers = tuple(handler for handler in logger.handlers if type(handler) is not logging.NullHandler)
            settings = (logger.level, handlers, tuple(logger.filters), logger.disabled, logger.propagate)
            if settings != _DEFAULT_LOGGER:
                loggers[name] = settings
    return loggers


def _signals() -> dict[str, Any]:
    wakeup = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wakeup)
    return {
        **{signal.Signals(number).name: signal.getsignal(number) for number in _SIGNALS},
        "wakeup descriptor": wakeup,
        "blocked": signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        "timer": signal.getitimer(signal.ITIMER_REAL)[1],
    }


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith(_OF_PYTEST)}


def _settings() -> dict[str, Any]:
    umask = os.umask(0o077)
    os.umask(umask)
    return {
        "current folder": os.getcwd(),
        "umask": oct(umask),
        "network namespace": os.stat("/proc/thread-self/ns/net").st_ino,
        "dumpable": _libc.prctl(_PR_GET_DUMPABLE, 0, 0, 0, 0),
        "priority": os.getpriority(os.PRIO_PROCESS, 0),
        "processors": os.sched_getaffinity(0),
        "socket timeout": socket.getdefaulttimeout(),
        "garbage collector": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count()),
        "recursion limit": sys.getrecursionlimit(),
        "hooks": (sys.excepthook, sys.displayhook, sys.unraisablehook, threading.excepthook, sys.getprofile()),
        "sys.path": list(sys.path),
        "sys.argv": list(sys.argv),
    }


def _event_loop() -> dict[str, Any]:
    policy = asyncio.get_event_loop_policy()
    return {"of this thread": (type(policy), getattr(getattr(policy, "_local", None), "_loop", None))}


def _limits() -> dict[str, tuple[int, int]]:
    return {name: resource.getrlimit(number) for name, number in _LIMITS.items()}


def _files() -> dict[int, str]:
    """Matplotlib keeps the fonts open that it has used."""
    files = {}
    for name in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # the descriptor of this listing
            file = os.readlink(f"/proc/self/fd/{name}")
            if not file.endswith(".ttf"):
                files[int(name)] = file
    return files


def _children() -> dict[str, str]:
    """Also those that have ended while this process has not waited for them."""
    children: list[str] = []
    for thread in os.listdir("/proc/self/task"):
        with suppress(FileNotFoundError), open(f"/proc/self/task/{thread}/children") as file:
            children += file.read().split()
    return dict.fromkeys(children, "running, or not waited for")


def _threads() -> dict[threading.Thread, str]:
    return dict.fromkeys(threading.enumerate(), "running")


def _namespaces() -> dict[str, str]:
    """Those with the number of this process in their names: other workers of the test run make some too."""
    with suppress(FileNotFoundError):
        return dict.fromkeys([name for name in os.listdir("/run/netns") if f"-{os.getpid()}-" in name], "there")
    return {}


def _modules() -> dict[str, ModuleType]:
    return dict(sys.modules)


_SETTINGS: Final[Mapping[str, Callable[[], Mapping[Any, Any]]]] = {
    "structlog": _structlog,
    "logger": _loggers,
    "signal": _signals,
    "environment variable": _environment,
    "setting": _settings,
    "resource limit": _limits,
    "module": _modules,
}
_RESOURCES: Final[Mapping[str, Callable[[], Mapping[Any, Any]]]] = {
    "event loop": _event_loop,
    "file descriptor": _files,
    "child process": _children,
    "thread": _threads,
    "network namespace": _namespaces,
}


def open_once() -> None:
    """Open what a process opens at its first use and keeps until it ends."""
    note_pauses()  # a thread
    x25519_public_key(bytes(32))  # modules of `cryptography`, some of which have no specification
    free_port()  # a socket: the lock of a block of ports
    uvloop.new_event_loop().close()  # a pipe of libuv, for signals
    resource_tracker.ensure_running()  # a child process, for processes of `multiprocessing`


@contextmanager
def no_trace(whose: str, *, has_resources: bool = True) -> Iterator[None]:
    """Raise an AssertionError that names what the block left in this process; resources only if it has its own."""
    kinds = {**_SETTINGS, **_RESOURCES} if has_resources else _SETTINGS
    before = _look(kinds)
    yield
    after = _look(kinds)
    if after != before and list(_traces(before, after)):
        _settle(before.get("thread", {}))
        traces = list(_traces(before, _look(kinds)))
        assert not traces, "\n  ".join([f"{whose} left in its process:", *traces])


def _look(kinds: Mapping[str, Callable[[], Mapping[Any, Any]]]) -> State:
    return {kind: look() for kind, look in kinds.items()}


def _settle(threads_before: Mapping[Any, Any]) -> None:
    """Let threads end that have nothing left to do, and close what only a reference cycle keeps open."""
    deadline = monotonic() + END_S
    for thread in _threads().keys() - threads_before.keys():
        thread.join(max(0.0, deadline - monotonic()))
    gc.collect()


def _traces(before: State, after: State) -> Iterator[str]:
    for kind in before:
        if before[kind] != after[kind]:
            yield from _differences(kind, before[kind], after[kind])


def _differences(kind: str, before: Mapping[Any, Any], after: Mapping[Any, Any]) -> Iterator[str]:
    for name in {**before, **after}:
        was, now = before.get(name, _ABSENT), after.get(name, _ABSENT)
        if was == now or (now is _ABSENT and kind in _RESOURCES):
            continue
        if was is _ABSENT:
            if kind != "module" or not _is_imported(name, now):
                yield f"{kind} {name} is new: {_shown(kind, name, now)}"
        elif now is _ABSENT:
            yield f"{kind} {name} is gone: it was {was}"
        else:
            yield f"{kind} {name} is {now}: it was {was}"


def _is_imported(name: str, module: object) -> bool:
    """Whether a module is not put there by a test. Cython makes one without a specification, for its own types."""
    return getattr(module, "__spec__", None) is not None or name.startswith("_cython_")


def _shown(kind: str, name: Any, value: Any) -> str:
    """With the addresses of a socket."""
    if kind == "file descriptor" and value.startswith("socket:"):
        with suppress(OSError), socket.socket(fileno=os.dup(name)) as copy:
            return repr(copy)
    if kind == "child process":
        return _command(name) or "ended, and not waited for"
    return str(value)


def _command(process: str) -> str:
    """Empty if the process has ended. For a moment after its start, the kernel does not show the new command."""
    deadline = monotonic() + END_S
    with suppress(OSError):
        while True:
            with open(f"/proc/{process}/cmdline") as command, open(f"/proc/{process}/stat") as stat:
                words, has_ended = command.read(), stat.read().rpartition(")")[2].split()[0] == "Z"
            if words or has_ended or monotonic() > deadline:
                return words.replace("\0", " ")
    return ""
