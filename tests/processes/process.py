"""A daemon as a process, with its folder and its configuration."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

from tests import waiting
from tests.processes.toml import to_toml
from tests.processes.udp import Sockaddr
from tests.waiting import PATIENCE_S
from uavlinkd.config import keys
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

POLL_S = 0.01


WITHOUT_UVLOOP = "import sys; sys.modules['uvloop'] = None; from uavlinkd.cli import main; sys.exit(main())"


ODD = ("1", "3", "5", "7", "9")


Status = dict[str, Any]


class DaemonProcess:
    """A daemon: its folder, its configuration as plain values, and its process while there is one.

    ``config`` may be changed until :meth:`start`, which writes the file.
    """

    def __init__(self, name: str, folder: Path, listen: Sequence[str]) -> None:
        self.name = name
        self.folder = folder
        folder.mkdir()
        self.private_key = keys.generate_private_key()
        self.public_key = keys.public_key_text(self.private_key)
        keys.write_secret_file(folder / "daemon.key", self.private_key)
        self.config: dict[str, Any] = {
            "name": name,
            "private_key_file": "daemon.key",
            "listen": list(listen),
            "control_socket": "control.sock",
            "link": {},
            "endpoint": [],
            "peer": [],
        }
        self.lines: list[str] = []
        self.statuses: list[str] = []
        """All that it answered, as JSON."""
        self.exit_status: int | None = None
        self.command = "run"
        self.launcher: tuple[str, ...] = ()
        """The command that starts the daemon, such as ``ip netns exec NAME``. It execs the daemon: one process."""
        self.code = ""
        """Python that runs the daemon, if it is not the package as it is."""
        self.is_planted = False
        """Whether a test plants exceptions in it: then it logs their tracebacks."""
        self.environ: dict[str, str] = {}
        """Additional variables of its environment, for every start."""
        self._process: asyncio.subprocess.Process | None = None
        self._reading: asyncio.Task[None] | None = None

    # Its configuration.

    @property
    def config_file(self) -> Path:
        """Where :meth:`start` writes the configuration."""
        return self.folder / "daemon.toml"

    @property
    def address(self) -> str:
        """Where peers call it: the first listen address."""
        return str(self.config["listen"][0])

    @property
    def sockaddr(self) -> Sockaddr:
        """The same, for a socket."""
        host, _, port = self.address.rpartition(":")
        return host.strip("[]"), int(port)

    def add_endpoint(self, name: str, url: str = "", **settings: object) -> Sockaddr:
        """Add a local endpoint, by default a ``udpin`` on a free port of loopback; host and port of its URL."""
        url = url or f"udpin:127.0.0.1:{free_port()}"
        self.config["endpoint"].append({"name": name, "url": url, **settings})
        host, _, port = url.partition(":")[2].rpartition(":")
        return host.strip("[]"), int(port)

    def add_peer(
        self, peer: DaemonProcess, addresses: Sequence[str], psk: str | None = None, **settings: object
    ) -> None:
        """Add a peer, with a key shared with it where there is one. It may say what ``settings`` do not refuse."""
        section: dict[str, object] = {"name": peer.name, "public_key": peer.public_key, "addresses": list(addresses)}
        if psk is not None:
            section["psk_file"] = f"{peer.name}.psk"
            keys.write_secret_file(self.folder / f"{peer.name}.psk", psk)
        self.config["peer"].append({**section, **_open_policy(settings)})

    def write_config(self) -> Path:
        self.config_file.write_text(to_toml(self.config))
        return self.config_file

    # Its life.

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def is_running(self) -> bool:
        return self._process is not None and self._process.returncode is None

    async def start(self, environ: Mapping[str, str] | None = None) -> None:
        """Start a process with the configuration as it is now. It is not yet ready then."""
        assert not self.is_running
        self.write_config()
        self.exit_status = None
        self._process = await asyncio.create_subprocess_exec(
            *end_with_parent(*self.launcher, sys.executable, *self._executable(), self.command),
            *("--config", str(self.config_file)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env={**os.environ, **self.environ, **(environ or {})},
        )
        assert self._process.stdout is not None
        self._reading = asyncio.create_task(self._read(self._process.stdout))

    def _executable(self) -> tuple[str, str]:
        """The daemon, as it is; every other one as if uvloop were not installed, so that both loops are tested."""
        if self.code:
            return "-c", self.code
        return ("-c", WITHOUT_UVLOOP) if self.name.endswith(ODD) else ("-m", "uavlinkd")

    async def ready(self) -> Status:
        """Wait until the daemon answers on its control socket."""
        return await self.until(lambda status: True)

    async def send_signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    async def ended(self) -> int:
        """Wait for its end; its exit status, negative for the signal that killed it."""
        assert self._process is not None
        assert self._reading is not None
        self.exit_status = await asyncio.wait_for(self._process.wait(), PATIENCE_S)
        await self._reading
        return self.exit_status

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        await self.send_signal(number)
        return await self.ended()

    async def kill(self) -> None:
        """End it as a power failure would."""
        assert await self.stop(signal.SIGKILL) == -signal.SIGKILL

    async def _read(self, stream: asyncio.StreamReader) -> None:
        async for line in stream:
            self.lines.append(line.decode(errors="backslashreplace").rstrip("\n"))

    # What it says.

    async def ask(self, request: str) -> dict[str, Any]:
        """The answer to a request at its control socket. Raises OSError if there is no answer."""
        reader, writer = await asyncio.open_unix_connection(self.folder / "control.sock", limit=1 << 24)
        try:
            writer.write(f"{request}\n".encode())
            line = await asyncio.wait_for(reader.readline(), PATIENCE_S)
        finally:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
        self.statuses.append(line.decode())
        answer: dict[str, Any] = json.loads(line)
        return answer

    async def status(self) -> Status:
        """Ask it how it is. Raises OSError if there is no answer."""
        return await self.ask("status")

    async def until(self, condition: Callable[[Status], bool], timeout_s: float = PATIENCE_S) -> Status:
        """Ask it until what it answers fulfils a condition, and return that."""
        latest: Status = {}
        give_up_at = monotonic() + timeout_s
        while monotonic() < give_up_at:
            with suppress(OSError, ValueError):
                latest = await self.status()
                if condition(latest):
                    return latest
            if not self.is_running:
                await self.ended()
                raise AssertionError("\n".join([f"{self.name} ended with {self.exit_status}:", *self.lines]))
            await asyncio.sleep(POLL_S)
        raise AssertionError(f"{self.name} did not come to that; it says: {json.dumps(latest)}")

    async def until_linked(self, timeout_s: float = PATIENCE_S) -> Status:
        return await self.until(
            lambda status: all(peer["state"] == "up" for peer in status["peers"].values()), timeout_s
        )

    def events(self, name: str | None = None, **facts: object) -> list[dict[str, Any]]:
        """Its log: the lines with this event name and these facts."""
        parsed = [json.loads(line) for line in self.lines if line.startswith("{")]
        wanted = {**facts, **({} if name is None else {"event": name})}
        return [line for line in parsed if all(line.get(key) == value for key, value in wanted.items())]

    async def until_logged(self, name: str, *, timeout_s: float = PATIENCE_S, **facts: object) -> dict[str, Any]:
        """Wait for a log line, and return the newest such."""
        await waiting.until(lambda: bool(self.events(name, **facts)), timeout_s)
        return self.events(name, **facts)[-1]

    @property
    def plain_lines(self) -> list[str]:
        """Output that is not a log line."""
        return [line for line in self.lines if not line.startswith("{")]


def _open_policy(settings: Mapping[str, object]) -> dict[str, object]:
    """A peer's settings, with all that they do not name allowed in so many words."""
    lists = {"allow_in", "allow_out"}
    allowed: dict[str, object] = {"system_ids": "all"}
    if "role" not in settings:
        allowed |= {key: ["all"] for key in lists} if lists & set(settings) else {"role": "all"}
    return allowed | dict(settings)
