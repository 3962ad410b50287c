"""What the service manager is told, over a socket like the service manager's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from uavlinkd.ops import sdnotify
from uavlinkd.ops.sdnotify import UNSENT_MESSAGES, Supervisor

PID = 4242


class Manager:
    """A socket of a service manager, and what came to it."""

    def __init__(self, address: str) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.sock.bind(address)
        self.sock.setblocking(False)

    def heard(self) -> list[str]:
        """What came since the last call."""
        messages: list[str] = []
        while True:
            try:
                messages.append(self.sock.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture
def path(tmp_path: Path) -> str:
    """Where the manager's socket is."""
    return str(tmp_path / "notify")


@pytest.fixture
def manager(path: str) -> Iterator[Manager]:
    """A manager that listens."""
    manager = Manager(path)
    yield manager
    manager.sock.close()


def test_life_is_told_in_order(manager: Manager, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ready, reloading with the time of systemd's monotonic clock in microseconds, ready again, stopping."""
    monkeypatch.setattr(sdnotify, "monotonic", lambda: 12.5)
    supervisor = Supervisor({"NOTIFY_SOCKET": path}, PID)
    supervisor.ready()
    supervisor.reloading()
    supervisor.ready()
    supervisor.stopping()
    assert manager.heard() == ["READY=1", "RELOADING=1\nMONOTONIC_USEC=12500000", "READY=1", "STOPPING=1"]


def test_an_abstract_socket_is_reached() -> None:
    """A name that begins with @ is no path."""
    name = f"uavlinkd-test-{os.getpid()}"
    manager = Manager(f"\0{name}")
    supervisor = Supervisor({"NOTIFY_SOCKET": f"@{name}"}, PID)
    supervisor.ready()
    assert manager.heard() == ["READY=1"]
    supervisor.stopping()
    manager.sock.close()


@pytest.mark.parametrize("name", [None, "", "@", "relative/path", "vsock:2:1234"])
def test_without_a_manager_nothing_happens(name: str | None) -> None:
    """No variable, or one that names no Unix socket."""
    supervisor = Supervisor({} if name is None else {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000"}, PID)
    supervisor.ready()
    supervisor.reloading()
    supervisor.turn("1 of 1 peers up", 2.0)
    supervisor.stopping()


def test_a_manager_that_is_gone_costs_nothing(path: str) -> None:
    """Nothing is raised where nobody listens; what must arrive waits, a bounded number of messages."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path}, PID)
    for _ in range(UNSENT_MESSAGES):
        supervisor.reloading()
        supervisor.ready()
    supervisor.turn("0 of 1 peers up", 2.0)
    manager = Manager(path)
    heard: list[str] = []
    for _ in range(3):  # its queue is shorter than what waits
        supervisor.turn("0 of 1 peers up", 3.0)
        heard += manager.heard()
    assert heard[-2:] == ["READY=1", "STATUS=0 of 1 peers up"]
    assert len(heard) == UNSENT_MESSAGES + 1
    supervisor.stopping()
    manager.sock.close()


def test_a_manager_that_does_not_read_holds_nobody_up(manager: Manager, path: str) -> None:
    """When its socket is full, messages wait for their turn, and arrive in order."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path}, PID)
    number = 0
    while not supervisor._unsent:
        supervisor.turn(f"status {number}", 0.0)
        supervisor.ready()
        number += 1
    manager.heard()
    supervisor.turn("at last", 1.0)
    assert manager.heard() == ["READY=1", "STATUS=at last"]
    supervisor.stopping()


def test_status_is_told_when_it_changes(manager: Manager, path: str) -> None:
    """And a note stands behind it, until the next time that all is well."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path}, PID)
    for status in ("0 of 2 peers up", "0 of 2 peers up", "1 of 2 peers up"):
        supervisor.turn(status, 0.0)
    supervisor.ready("the new configuration was refused")
    supervisor.turn("1 of 2 peers up", 1.0)
    supervisor.ready()
    supervisor.turn("1 of 2 peers up", 2.0)
    assert manager.heard() == [
        "STATUS=0 of 2 peers up",
        "STATUS=1 of 2 peers up",
        "READY=1",
        "STATUS=1 of 2 peers up; the new configuration was refused",
        "READY=1",
        "STATUS=1 of 2 peers up",
    ]
    supervisor.stopping()


def test_watchdog_hears_of_turns_twice_in_its_time(manager: Manager, path: str) -> None:
    """Of turns alone: a loop that stands still says nothing. Just before half of the time, not yet; at it, yes."""
    environ = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "6000000", "WATCHDOG_PID": str(PID)}
    supervisor = Supervisor(environ, PID)
    heard = []
    for now in (10.0, 11.0, 12.999, 13.0, 15.999, 16.0):
        supervisor.turn("", now)
        heard.append(manager.heard())
    assert heard == [["WATCHDOG=1"], [], [], ["WATCHDOG=1"], [], ["WATCHDOG=1"]]
    supervisor.stopping()


@pytest.mark.parametrize(
    "environ",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "-1"},
        {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},
    ],
)
def test_no_watchdog_hears_nothing(manager: Manager, path: str, environ: dict[str, str]) -> None:
    """Where there is none, or it means another process, it is not fed again and again."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path, **environ}, PID)
    for now in range(100):
        supervisor.turn("", float(now))
    assert manager.heard() == []
    supervisor.stopping()
