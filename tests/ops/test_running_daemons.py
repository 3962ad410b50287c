"""`status` and `reload` without an option find the daemons that run as services."""

from __future__ import annotations

import asyncio
import json
import os
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.ops.test_status_screen import peer, status_of
from uavlinkd.cli import main
from uavlinkd.ops import commands, control
from uavlinkd.ops.control import ask
from uavlinkd.system import services
from uavlinkd.system.terminal import FAILED, OK, WRONG


class Daemons:
    """Control sockets in a folder, each with a fixed answer; without one, no daemon listens."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.answers: dict[Path, dict[str, Any]] = {}
        self.requests: list[tuple[Path, str]] = []

    def add(self, answer: dict[str, Any] | None, instance: str = "") -> Path:
        """The socket of the service, or of an instance."""
        path = self.folder / instance / "control.sock"
        path.parent.mkdir(exist_ok=True, parents=True)
        path.touch()
        if answer is not None:
            self.answers[path] = answer
        return path

    def ask(self, path: Path, request: str, **options: Any) -> dict[str, Any]:
        """In place of a request through the socket."""
        self.requests.append((path, request))
        return self.answers[path] if path in self.answers else ask(path, request, **options)


@pytest.fixture
def daemons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Daemons:
    """A folder in place of /run/uavlinkd."""
    daemons = Daemons(tmp_path / "run")
    monkeypatch.setattr(commands, "RUNTIME_FOLDER", daemons.folder)
    monkeypatch.setattr(services, "FOLDER", tmp_path / "etc")
    monkeypatch.setattr(control, "ask", daemons.ask)
    return daemons


def status(name: str, state: str = "up") -> dict[str, Any]:
    """The status of a daemon with one peer."""
    return status_of({"drone1": peer(state, public_key="A=")}, name=name)


@pytest.mark.parametrize("command", ["status", "status --json", "netcheck --json", "reload"])
@pytest.mark.parametrize("answer", [{}, {"frames_pass": 1, "peers": 7}, {"relays": [], "problems": 5, "paths": "x"}])
def test_answer_of_another_form_ends_a_command_with_a_sentence(
    daemons: Daemons, capsys: pytest.CaptureFixture[str], command: str, answer: dict[str, Any]
) -> None:
    """A daemon of another version, or one that an attacker replaced."""
    daemons.add(answer)
    main(command.split())
    assert "Traceback" not in "".join(capsys.readouterr())


def test_answer_does_not_act_on_the_terminal(daemons: Daemons, capsys: pytest.CaptureFixture[str]) -> None:
    """Escape sequences, C1 controls and bidirectional overrides of a captured daemon are written as text."""
    answer = json.loads(json.dumps(status("gs")).replace("drone1", "d\\u001b]0;x\\u0007\\u009b2J\\u202e"))
    server = control.ControlServer(daemons.add(None).with_name("real.sock"), lambda request: answer)

    async def shown() -> None:
        await server.start()
        await asyncio.to_thread(main, ["status", "--socket", str(daemons.folder / "real.sock")])
        await server.stop()

    asyncio.run(shown())
    printed = "".join(capsys.readouterr())
    assert r"\x1b]0" in printed
    assert not set(printed) & {"\x1b", "\x07", "\x9b", "\u202e"}


def test_several_daemons_are_shown_one_after_another(daemons: Daemons, capsys: pytest.CaptureFixture[str]) -> None:
    """The service first, then its instances by name; the exit status is the worst one."""
    daemons.add(status("ground"))
    assert main(["status"]) == OK
    assert "ground  1 of 1 peers up" in capsys.readouterr().out
    daemons.add(status("drone2", "waiting"), "drone2")
    daemons.add(status("drone1"), "drone1")
    assert main(["status"]) == FAILED
    out = capsys.readouterr().out
    assert out.index("ground  1 of 1") < out.index("drone1  1 of 1") < out.index("drone2  0 of 1")
    assert main(["status", "--json"]) == FAILED
    names = ["ground", "drone1", "drone2"]
    assert [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()] == names


def test_a_daemon_that_does_not_answer_does_not_hide_others(
    daemons: Daemons, capsys: pytest.CaptureFixture[str]
) -> None:
    """A socket that a killed daemon left is reported beside the others."""
    path = daemons.add(None)
    daemons.add(status("drone1"), "drone1")
    assert main(["status"]) == FAILED
    out, err = capsys.readouterr()
    assert "drone1  1 of 1 peers up" in out
    assert f"no daemon answers at {path}" in err


def test_services_that_are_stopped_are_named(
    daemons: Daemons, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To root, which sees every control socket: others learn that root would."""
    services.FOLDER.mkdir()
    for name in ("uavlinkd", "relay", "v8"):
        (services.FOLDER / f"{name}.toml").touch()
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert main(["status"]) == FAILED
    said = capsys.readouterr().err
    assert [line.split()[0] for line in said.splitlines()] == ["uavlinkd-relay", "uavlinkd", "uavlinkd@v8"]
    assert said.endswith(": sudo systemctl start uavlinkd@v8; its log: journalctl -u uavlinkd@v8\n")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["status"]) == FAILED
    assert "that this user may see (use sudo)" in capsys.readouterr().err


def test_daemon_of_this_folder_is_found(daemons: Daemons, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its control socket, if no service runs and the socket is this user's."""
    monkeypatch.chdir(daemons.folder.parent)
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind("gs.sock")
        daemons.answers[Path("gs.sock")] = status("gs")
        assert main(["status"]) == OK
        with monkeypatch.context() as patch:
            patch.setattr(os, "geteuid", lambda: Path("gs.sock").stat().st_uid + 1)
            assert main(["status"]) == FAILED
        daemons.add(status("drone1"))
        assert main(["status"]) == OK
    assert [path.name for path, _ in daemons.requests] == ["gs.sock", "control.sock"]


def test_reload_of_several_daemons_needs_a_name(daemons: Daemons, capsys: pytest.CaptureFixture[str]) -> None:
    """No daemon reads its file again by accident: the message lists the sockets."""
    paths = [daemons.add({"problems": [], "name": name}, name) for name in ("drone1", "drone2")]
    assert main(["reload"]) == WRONG
    err = capsys.readouterr().err
    assert all(f"--socket {path}" in err for path in paths)
    assert daemons.requests == []
    assert main(["reload", "--socket", str(paths[1])]) == OK
    assert capsys.readouterr().out == "drone2 reloaded\n"
    assert daemons.requests == [(paths[1], "reload")]
