"""What a mistake is made with: two daemons, their clients, and commands."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.udp import Sockaddr
from uavlinkd.cli import main
from uavlinkd.config.keys import write_secret_file

SEND_S = 0.2
WITHOUT_RIGHTS = ("setpriv", "--bounding-set=-dac_override,-dac_read_search", "--inh-caps=-all")
"""Root without its right to open the files of others, as another user."""
Frames = Callable[[int], Iterable[bytes]]


class Scene:
    """The daemons `here` and `there` of one mistake, both configured as peers, not yet started."""

    def __init__(self, stage: Stage, row: str, starting: asyncio.Semaphore) -> None:
        self.stage = stage
        self.row = row
        self.check = ""
        """What `check` printed about the mistake."""
        self.command = ""
        """What a command printed about the mistake."""
        self.tasks: list[asyncio.Task[None]] = []
        self.descriptors: list[int] = []
        self.processes: list[subprocess.Popen[bytes]] = []
        self._starting = starting

    @cached_property
    def here(self) -> DaemonProcess:
        """The daemon whose file has the mistake."""
        return self.stage.daemon(f"m{self.row}-here")

    @cached_property
    def there(self) -> DaemonProcess:
        """Its peer."""
        return self.stage.daemon(f"m{self.row}-there")

    def clone(self, original: DaemonProcess) -> DaemonProcess:
        """A third daemon, with the key and the partners of another one."""
        clone = self.stage.daemon(f"m{self.row}-clone")
        (clone.folder / "daemon.key").unlink()
        write_secret_file(clone.folder / "daemon.key", original.private_key)
        clone.config |= {key: original.config[key] for key in ("peer", "relay", "link") if key in original.config}
        return clone

    def introduce(self, here: dict[str, Any] | None = None, there: dict[str, Any] | None = None) -> None:
        """Make them peers. The settings are those of the [[peer]] in each file."""
        self.here.add_peer(self.there, [self.there.address], **(here or {}))
        self.there.add_peer(self.here, [self.here.address], **(there or {}))

    async def start(self, *daemons: DaemonProcess) -> None:
        """Start daemons, by default both. Few start at the same time."""
        for daemon in daemons or (self.here, self.there):
            async with self._starting:
                await daemon.start()
                await daemon.ready()

    async def send(self, into: Sockaddr, frames: Frames) -> None:
        """Let a client send frames five times a second until the end."""
        client = await self.stage.client()

        async def sending() -> None:
            number = 0
            while True:
                for frame in frames(number):
                    client.send(frame, into)
                number += 1
                await asyncio.sleep(SEND_S)

        self.tasks.append(asyncio.create_task(sending()))

    def namespace(self, rules: str) -> None:
        """Let both daemons run in a network of their own, with these rules of nftables."""
        script = f"ip link set lo up; nft -f - <<'END'\n{rules}\nEND\necho ready; exec sleep infinity"
        holder = subprocess.Popen(
            ["setpriv", "--pdeathsig=KILL", "unshare", "--net", "sh", "-euc", script],
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
        )
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"ready\n"
        self.processes.append(holder)
        for daemon in (self.here, self.there):
            daemon.launcher = ("nsenter", f"--net=/proc/{holder.pid}/ns/net")

    def close(self) -> None:
        """End what the mistake started beside its daemons."""
        for task in self.tasks:
            task.cancel()
        for descriptor in self.descriptors:
            os.close(descriptor)
        for process in self.processes:
            process.kill()
            process.communicate()


def said(*arguments: str) -> str:
    """What a command prints, on one line."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output), contextlib.suppress(SystemExit):
        main(arguments)
    return " ".join(output.getvalue().split())


async def said_by_process(*arguments: str, launcher: tuple[str, ...] = ()) -> str:
    """The same, as a process."""
    process = await asyncio.create_subprocess_exec(
        *(*launcher, sys.executable, "-m", "uavlinkd", *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "COLUMNS": "200"},
    )
    output, _ = await process.communicate()
    return " ".join(output.decode(errors="replace").split())


def checked(daemon: DaemonProcess) -> str:
    """What `check` prints about a daemon's file. The file is written as it will be at the start."""
    return said("check", "--config", str(daemon.write_config()))
