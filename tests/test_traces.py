"""A test that leaves something in its process fails, and the message names what it left."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_skips import ROOT, environment

DEEDS = {
    "asyncio.run(asyncio.sleep(0))": "",
    "structlog.configure(cache_logger_on_first_use=True)": "structlog cache_logger_on_first_use is True",
    "structlog.get_config()['processors'].clear()": "structlog processors is []",
    "logging.getLogger('some').setLevel('ERROR')": "logger some is new",
    "logging.disable()": "logger of all is 50: it was 0",
    "signal.signal(signal.SIGUSR1, signal.SIG_IGN)": "signal SIGUSR1 is",
    "signal.set_wakeup_fd(pipe[1])": "signal wakeup descriptor is",
    "signal.setitimer(signal.ITIMER_REAL, 900, 60)": "signal timer is 60.0",
    "os.environ['SOME'] = 'thing'": "environment variable SOME is new: thing",
    "del os.environ['PATH']": "environment variable PATH is gone: it was",
    "os.chdir('/')": "setting current folder is /: it was",
    "os.umask(0o123)": "setting umask is 0o123: it was",
    "asyncio.set_event_loop(asyncio.SelectorEventLoop())": "event loop of this thread is",
    "sys.path.append('/some')": "setting sys.path is",
    "sys.excepthook = print": "setting hooks is",
    "gc.disable()": "setting garbage collector is",
    "resource.setrlimit(resource.RLIMIT_NOFILE, (99, 99))": "resource limit RLIMIT_NOFILE is (99, 99): it was",
    "sys.modules['some'] = types.ModuleType('some')": "module some is new",
    "sys.modules['json'] = None": "module json is None: it was",
    "globals()['server'] = socket.create_server(('127.0.0.1', 0))": "laddr=('127.0.0.1'",
    "globals()['null'] = open('/dev/null')": "is new: /dev/null",
    "os.pipe()": "is new: pipe:",
    "threading.Thread(target=time.sleep, args=[900], daemon=True).start()": "thread <Thread",
    "globals()['sleeper'] = subprocess.Popen(['sleep', '9'], stdout=-3, stderr=-3)": "is new: sleep 9",
    "os.waitid(os.P_PID, os.posix_spawn('/bin/true', ['true'], {}), os.WEXITED | os.WNOWAIT)": "is new: ended, and",
    "import wave; subprocess.run(['true'])": "",
    "socket.socket().close()": "",
}
"""What a test does, and a part of the message; none if nothing is left."""

DO_EACH = """
import asyncio, gc, logging, os, resource, signal, socket, structlog, subprocess, sys, threading, time, types
from tests import traces
traces.END_S = 0.01
pipe = os.pipe()
os.set_blocking(pipe[1], False)
for deed in sys.argv[1:]:
    message = ""
    try:
        with traces.no_trace("this test"):
            exec(deed)
    except AssertionError as error:
        message = str(error)
    print("|".join(message.splitlines()), flush=True)
os._exit(0)
"""


@pytest.mark.long
def test_all_that_is_left_is_named() -> None:
    """One thing after the other, in a process that has no other work."""
    script = subprocess.run(
        [sys.executable, "-c", DO_EACH, *DEEDS], cwd=ROOT, capture_output=True, text=True, check=True
    )
    messages = script.stdout.splitlines()
    for (deed, part), message in zip(DEEDS.items(), messages, strict=True):
        assert part in message, deed
        assert bool(part) == bool(message), deed
        assert message.count("|") <= 4, f"{deed}: {message}"


TESTS = """
import asyncio, os, pytest, socket
from tests import conftest

conftest.END_S = 0.1

@pytest.fixture(scope="module")
def sockets():
    kept = []
    yield kept
    [kept.pop().close() for _ in kept[1:]]

def test_clean(): pass
def test_folder(): os.chdir("/")
async def test_task(): test_task.left = asyncio.create_task(asyncio.sleep(900))
def test_shared_one(sockets): sockets.append(socket.socket())
def test_shared_two(sockets): sockets.append(socket.socket())
def test_clean_again(monkeypatch): monkeypatch.setenv("SOME", "thing")
"""


@pytest.mark.long
def test_test_that_leaves_something_fails(tmp_path: Path) -> None:
    """It alone. What a fixture of a module leaves is an error of the module's last test."""
    (tmp_path / "test_it.py").write_text(TESTS)
    settings = ["-p", "tests.conftest", "-p", "no:randomly", "-p", "no:cacheprovider", "-o", "asyncio_mode=auto"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-rpE", *settings, str(tmp_path)],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    summary = [line.partition(" - ")[0] for line in done.stdout.splitlines() if line.startswith(("PASSED", "ERROR "))]
    errors = [line.rpartition("::")[2] for line in summary if line.startswith("ERROR")]
    assert errors == ["test_folder", "test_task", "test_clean_again"]
    assert sum(line.startswith("PASSED") for line in summary) == 6
    for message in ("this test left in its process:", "this test left in its event loop:", "this module left in"):
        assert done.stdout.count(f"AssertionError: {message}") == 1
