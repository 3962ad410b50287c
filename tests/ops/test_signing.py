"""``uavlinkd signing``: the files before and after, beside a daemon that is made up."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.killed_commands import KILLED, Stage
from uavlinkd.cli import main
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import LINK_ID
from uavlinkd.ops import signing as ops_signing
from uavlinkd.ops.control import ControlServer, ask
from uavlinkd.protocol.crypto import Secret

CONFIG = """name = "drone1"
private_key_file = "drone1.key"  # a comment that stays
control_socket = "c.sock"

[[endpoint]]
  name = "autopilot"  # on the cable
  url = "udpin:127.0.0.1:14550"

[endpoint.rate_in]
ATTITUDE = 10

# A station that listens.
[[endpoint]]
name = "gcs"
url = "udpout:127.0.0.1:14551"
"""
LINE = 'signing_key_file = "autopilot.key"\n'
SIGNED = CONFIG.replace('  name = "autopilot"', LINE + '  name = "autopilot"')
INLINE = CONFIG.partition("[[")[0] + 'endpoint = [{ name = "autopilot", url = "udpin:127.0.0.1:14550" }]\n'
ARMED: dict[str, object] = {"problem": "the autopilot is armed: disarm it", "is_changed": False}
UNKNOWN: dict[str, object] = {"problem": "the autopilot did not confirm it", "is_changed": None}


@contextmanager
def made_up_daemon(
    folder: Path, answer: dict[str, object] | None = None, key: str = ""
) -> Iterator[Callable[[], Any]]:
    """A daemon in a process of its own, whose autopilot does what it is told, or which gives another answer.

    Yields a function that returns all its requests and, as ``key``, the autopilot's key.
    """
    seen: dict[str, Any] = {"key": key, "requests": []}

    def respond(line: str) -> dict[str, object]:
        word, _, text = line.partition(" ")
        if word == "status":
            return {"endpoints": {"autopilot": {"signing": {"link_id": LINK_ID} if seen["key"] else None}}}
        if word == "signing":
            request = json.loads(text)
            seen["requests"].append(request)
            if answer is not None:
                return answer
            seen["key"] = request["key"]
            return {"problem": "", "is_changed": True, "system": 1, "accepts_unsigned": request["action"] == "setup"}
        return seen

    async def serve() -> None:
        await ControlServer(folder / "c.sock", respond).start()
        os.close(started)
        await asyncio.Event().wait()

    waits, started = os.pipe()
    if not (child := os.fork()):
        try:
            asyncio.run(serve())
        finally:
            os._exit(1)
    os.close(started)
    try:
        with open(waits, "rb") as pipe:
            pipe.read()  # until the other end is closed
        yield lambda: ask(folder / "c.sock", "seen")
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def write(folder: Path, text: str = CONFIG) -> Path:
    path = folder / "drone1.toml"
    path.write_text(text)
    if not (folder / "drone1.key").exists():
        keys.write_secret_file(folder / "drone1.key", keys.generate_private_key())
    return path


def run(action: str, path: Path, *more: str) -> int:
    return main(["signing", action, "--config", str(path), *more])


def key_files(folder: Path) -> dict[str, str]:
    """The content of each key file but the daemon's own and the one before it."""
    return {file.name: file.read_text().strip() for file in folder.glob("autopilot*") if file.suffix != ".old"}


def test_key_is_set_up_changed_and_cleared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The line is in the endpoint's section, the comments stay, and the key is in its file alone."""
    path = write(tmp_path)
    with made_up_daemon(tmp_path) as seen:
        assert run("setup", path) == 0
        assert path.read_text() == SIGNED
        first = seen()["key"]
        assert key_files(tmp_path) == {"autopilot.key": first}
        assert (tmp_path / "autopilot.key").stat().st_mode & 0o777 == 0o600
        assert "unsigned frames at this port too" in capsys.readouterr().out
        assert run("setup", path) == 0  # an autopilot that was reset, or a sender that claims to be one
        again = seen()["key"]
        assert again not in (first, "")
        assert run("rotate", path) == 0
        second = seen()["key"]
        assert second != first
        assert (tmp_path / "autopilot.key.old").read_text().strip() == again
        assert key_files(tmp_path) == {"autopilot.key": second}
        assert run("clear", path) == 0
        assert (path.read_text(), key_files(tmp_path)) == (CONFIG, {})
        assert keys.read_secret_file(tmp_path / "autopilot.key.old") == Secret(keys.decode_key(second))
        requests = seen()["requests"]
    assert [request["action"] for request in requests] == ["setup", "setup", "rotate", "clear"]
    assert all(request["endpoint"] == "autopilot" and request["link_id"] == LINK_ID for request in requests)
    out, err = capsys.readouterr()
    assert err == ""
    assert first not in out
    assert second not in out


@pytest.mark.parametrize("action", ["setup", "rotate", "clear"])
def test_refusal_changes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str], action: str) -> None:
    """The daemon's sentence is printed, without the key."""
    path, key = write(tmp_path), ""
    if action != "setup":
        key = keys.generate_psk()
        keys.write_secret_file(tmp_path / "autopilot.key", key)
        write(tmp_path, SIGNED)
    before = path.read_text(), key_files(tmp_path)
    with made_up_daemon(tmp_path, ARMED, key) as seen:
        assert run(action, path) == 1
        (request,) = seen()["requests"]
    assert (path.read_text(), key_files(tmp_path)) == before
    assert capsys.readouterr().err == "autopilot: the autopilot is armed: disarm it\n"
    assert bool(request["key"]) == (action != "clear")


def test_key_that_the_autopilot_may_have_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Until a run with the same key succeeds, also over one that changes nothing."""
    path = write(tmp_path)
    with made_up_daemon(tmp_path, UNKNOWN) as seen:
        assert run("setup", path) == 1
        kept = seen()["requests"][0]["key"]
        assert f"may have the key in {tmp_path}/autopilot.key.new" in capsys.readouterr().err
        assert run("clear", path) != 0
        assert "`uavlinkd signing setup` was interrupted, run it again" in capsys.readouterr().err
    assert key_files(tmp_path) == {"autopilot.key.new": kept}
    with made_up_daemon(tmp_path, ARMED):
        assert run("setup", path) == 1
    assert key_files(tmp_path) == {"autopilot.key.new": kept}
    with made_up_daemon(tmp_path) as seen:
        assert run("setup", path) == 0
        assert seen()["key"] == kept
    assert key_files(tmp_path) == {"autopilot.key": kept}


def test_clear_keeps_a_key_that_the_autopilot_may_have(tmp_path: Path) -> None:
    """Who forges a HEARTBEAT while the autopilot is off makes it look cleared."""
    path = write(tmp_path)
    with made_up_daemon(tmp_path):
        assert run("setup", path) == 0
    before = (tmp_path / "autopilot.key").read_text()
    with made_up_daemon(tmp_path, UNKNOWN) as seen:
        assert run("rotate", path) == 1
        kept = seen()["requests"][0]["key"]
    with made_up_daemon(tmp_path):
        assert run("clear", path) == 0
    assert key_files(tmp_path) == {"autopilot.key.new": kept}
    assert (tmp_path / "autopilot.key.old").read_text() == before


def test_interrupted_command_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon goes on after Ctrl-C."""
    path = write(tmp_path)

    def interrupt(socket: Path, request: str, *more: float) -> dict[str, Any]:
        if request != "status":
            raise KeyboardInterrupt
        return ask(socket, request, *more)

    with made_up_daemon(tmp_path):
        with monkeypatch.context() as patch:
            patch.setattr(ops_signing, "ask", interrupt)
            assert run("setup", path) == 1
        assert "may go on. What the autopilot has is not known: run this command again" in capsys.readouterr().err
        assert run("setup", path) == 0


def test_disk_that_refuses_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The autopilot has the key then: another run ends it."""
    path = write(tmp_path)

    def refuse(one: Path, _: Path) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(one))

    with made_up_daemon(tmp_path) as seen:
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", refuse)
            assert run("setup", path) == 1
        assert "autopilot.key.new: Read-only file system: mend that" in capsys.readouterr().err
        assert run("setup", path) == 0
        assert key_files(tmp_path) == {"autopilot.key": seen()["key"]}


@pytest.mark.parametrize(
    ("action", "text", "more", "says"),
    [
        ("setup", CONFIG, (), "no daemon answers"),
        ("clear", SIGNED, (), "no daemon answers"),
        ("setup", CONFIG, ("--endpoint", "other"), "one of: autopilot, gcs"),
        ("setup", CONFIG.replace("autopilot", "fc"), (), "one of: fc, gcs"),
        ("rotate", CONFIG, (), "has no key"),
        ("clear", CONFIG, (), "has no key"),
        ("setup", CONFIG.replace("14551", "14550"), (), "has the port of"),
        ("setup", INLINE, (), "as a section of its own\n"),
        ("setup", CONFIG.replace('"autopilot"', '"drone1"'), ("--endpoint", "drone1"), "another key of this file"),
    ],
)
def test_what_cannot_be_done_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], action: str, text: str, more: tuple[str, ...], says: str
) -> None:
    """The daemon is not asked."""
    path = write(tmp_path, text)
    if text == SIGNED:
        keys.write_secret_file(tmp_path / "autopilot.key", keys.generate_psk())
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with ExitStack() as stack:
        seen = None if "answers" in says else stack.enter_context(made_up_daemon(tmp_path))
        assert run(action, path, *more) != 0
        assert seen is None or seen()["requests"] == []
        before |= {} if seen is None else {"c.sock": b""}
        after = {file.name: file.read_bytes() if file.is_file() else b"" for file in tmp_path.iterdir()}
    err = capsys.readouterr().err
    assert says in err
    assert "is not known" not in err
    assert after == before


def test_keys_of_a_service_are_in_its_folder(tmp_path: Path) -> None:
    """The only endpoint needs no name."""
    path = write(tmp_path, CONFIG.partition("# A station")[0].replace("autopilot", "fc"))
    folder = tmp_path / "keys"
    folder.mkdir()
    (tmp_path / "drone1.key").rename(folder / "drone1.key")
    with made_up_daemon(tmp_path):
        assert run("setup", path, "--keys", str(folder)) == 0
    assert sorted(file.name for file in folder.iterdir()) == ["drone1.key", "fc.key"]
    assert 'signing_key_file = "fc.key"' in path.read_text()


@pytest.mark.parametrize("action", ["setup", "rotate", "clear"])
def test_killed_at_each_change_and_run_again(tmp_path: Path, action: str) -> None:
    """The configuration is always valid, the autopilot's key is always in a file, and another run ends it."""
    command, killed = "signing {} --config drone1.toml", 0
    while True:
        stage = Stage(tmp_path / str(killed))
        path = write(stage.folder)
        with made_up_daemon(stage.folder) as seen:
            if action != "setup":
                assert stage.run(command.format("setup"))[0] == 0
            status, _ = stage.run(command.format(action), kill_at=killed)
            if status != KILLED:
                break
            load_config(path, {})
            assert seen()["key"] in {"", *key_files(stage.folder).values()}
            status, _ = stage.run(command.format(action))
            key = seen()["key"]
        if action == "clear":
            assert (key, path.read_text()) == ("", CONFIG)
        else:
            assert status == 0
            assert (path.read_text(), key_files(stage.folder)) == (SIGNED, {"autopilot.key": key})
        assert not [file for file in stage.folder.glob(".*") if not file.name.startswith(".drone1.key")]
        killed += 1
    assert killed >= 4
