"""Reports to the service manager, over a socket like that of systemd."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from uavlinkd.ops.sdnotify import Supervisor

PID = 4242


class Manager:
    """The socket of a service manager, and the messages that it received."""

    def __init__(self, address: str) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.sock.bind(address)
        self.sock.setblocking(False)

    def received(self) -> list[str]:
        """The messages since the last call."""
        messages: list[str] = []
        while True:
            try:
                messages.append(self.sock.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture
def path(tmp_path: Path) -> str:
    """The path of the manager's socket."""
    return str(tmp_path / "notify")


@pytest.fixture
def manager(path: str) -> Iterator[Manager]:
    """A listening manager."""
    manager = Manager(path)
    yield manager
    manager.sock.close()


@pytest.mark.parametrize("name", [None, "@", "relative/path"])
def test_without_a_manager_no_message_is_sent(name: str | None) -> None:
    """The variable is missing, or does not name a Unix socket."""
    supervisor = Supervisor({} if name is None else {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000"}, PID)
    supervisor.ready()
    supervisor.turn("1 of 1 peers up", 2.0)
    supervisor.stopping()


def test_hanging_manager_does_not_delay_the_daemon(manager: Manager, path: str) -> None:
    """While its socket is full, messages wait, and later arrive in order."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path}, PID)
    number = 0
    while not supervisor._unsent:
        supervisor.turn(f"status {number}", 0.0)
        supervisor.ready()
        number += 1
    manager.received()
    supervisor.turn("at last", 1.0)
    assert manager.received() == ["READY=1", "STATUS=at last"]
    supervisor.stopping()


def test_watchdog_is_fed_twice_per_interval(manager: Manager, path: str) -> None:
    """Only a turn of the loop in which work moves: just before half of the interval not, at half and later, yes."""
    environ = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "6000000", "WATCHDOG_PID": str(PID)}
    supervisor = Supervisor(environ, PID)
    received = []
    for now in (10.0, 11.0, 12.999, 13.0, 15.999, 16.0, 19.5):
        supervisor.turn("", now, work_moves=now != 16.0)
        received.append(manager.received())
    assert received == [["WATCHDOG=1"], [], [], ["WATCHDOG=1"], [], [], ["WATCHDOG=1"]]
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
def test_without_a_watchdog_nothing_is_fed(manager: Manager, path: str, environ: dict[str, str]) -> None:
    """There is no watchdog, or it is for another process."""
    supervisor = Supervisor({"NOTIFY_SOCKET": path, **environ}, PID)
    for now in range(100):
        supervisor.turn("", float(now))
    assert manager.received() == []
    supervisor.stopping()
