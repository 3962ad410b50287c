"""`status`, `reload` and `peer list` without an option find the daemons that run as services."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ops.test_status_screen import peer, status_of
from uavlinkd.cli import main
from uavlinkd.ops import commands
from uavlinkd.system.terminal import FAILED, OK, WRONG


class Daemons:
    """Control sockets in a folder, each with a fixed answer."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.requests: list[tuple[str, str]] = []
        self._sockets: list[socket.socket] = []

    def add(self, name: str, answer: dict[str, Any], instance: str = "") -> Path:
        """Serve an answer at the socket of the service, or of an instance."""
        path = self.folder / instance / "control.sock"
        path.parent.mkdir(exist_ok=True, parents=True)
        server = socket.socket(socket.AF_UNIX)
        server.bind(str(path))
        server.listen()
        self._sockets.append(server)
        threading.Thread(target=self._serve, args=(server, name, answer), daemon=True).start()
        return path

    def _serve(self, server: socket.socket, name: str, answer: dict[str, Any]) -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                self.requests.append((name, connection.recv(100).decode().strip()))
                connection.sendall(json.dumps(answer).encode() + b"\n")

    def close(self) -> None:
        """Stop to serve; the sockets' files stay."""
        while self._sockets:
            server = self._sockets.pop()
            server.shutdown(socket.SHUT_RDWR)
            server.close()


@pytest.fixture
def daemons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemons]:
    """A folder in place of /run/uavlinkd; short enough for the path of a socket."""
    monkeypatch.chdir(tmp_path)
    folder = Path("run")
    monkeypatch.setattr(commands, "RUNTIME_FOLDER", folder)
    daemons = Daemons(folder)
    yield daemons
    daemons.close()


def status(name: str, state: str = "up") -> dict[str, Any]:
    """The status of a daemon with one peer."""
    return status_of({"drone1": peer(state, public_key="A=")}, name=name)


def test_several_daemons_are_shown_one_after_another(daemons: Daemons, capsys: pytest.CaptureFixture[str]) -> None:
    """The service first, then its instances by name; the exit status is the worst one."""
    daemons.add("ground", status("ground"))
    assert main(["status"]) == OK
    assert "ground  1 of 1 peers up" in capsys.readouterr().out
    daemons.add("drone2", status("drone2", "waiting"), "drone2")
    daemons.add("drone1", status("drone1"), "drone1")
    assert main(["status"]) == FAILED
    out = capsys.readouterr().out
    assert out.index("ground  1 of 1") < out.index("drone1  1 of 1") < out.index("drone2  0 of 1")
    assert main(["status", "--json"]) == FAILED
    assert [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()] == [
        "ground",
        "drone1",
        "drone2",
    ]
    assert main(["peer", "list"]) == OK
    assert [line for line in capsys.readouterr().out.splitlines() if line.endswith(":")] == [
        "ground:",
        "drone1:",
        "drone2:",
    ]


def test_a_daemon_that_does_not_answer_does_not_hide_others(
    daemons: Daemons, capsys: pytest.CaptureFixture[str]
) -> None:
    """A socket that a killed daemon left is reported beside the others."""
    path = daemons.add("killed", {})
    daemons.close()
    daemons.add("drone1", status("drone1"), "drone1")
    assert main(["status"]) == FAILED
    out, err = capsys.readouterr()
    assert "drone1  1 of 1 peers up" in out
    assert f"no daemon answers at {path}" in err


def test_reload_of_several_daemons_needs_a_name(daemons: Daemons, capsys: pytest.CaptureFixture[str]) -> None:
    """No daemon reads its file again by accident: the message lists the sockets."""
    paths = [daemons.add(name, {"problems": [], "name": name}, name) for name in ("drone1", "drone2")]
    assert main(["reload"]) == WRONG
    err = capsys.readouterr().err
    assert all(f"--socket {path}" in err for path in paths)
    assert daemons.requests == []
    assert main(["reload", "--socket", str(paths[1])]) == OK
    assert capsys.readouterr().out == "drone2 reloaded\n"
    assert daemons.requests == [("drone2", "reload")]
