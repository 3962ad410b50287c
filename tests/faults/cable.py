"""Two hosts of our own, network namespaces with a cable between them, in which the network can be broken."""

from __future__ import annotations

import os
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.compose.cluster import run
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults.talk import Talk, prepare

PORT = 5790
ADDRESSES = ("10.213.77.1", "10.213.77.2")
_numbers = count()


class Cable:
    """Daemons at both ends of a cable, linked and talking; the first of them is the one that suffers."""

    def __init__(self, stage: Stage, victim: str) -> None:
        name = f"uavfault-{os.getpid()}-{next(_numbers)}"
        self.hosts = (f"{name}-a", f"{name}-b")
        other = "drone1" if victim == "drone0" else "drone0"
        self.victim, self.other = (
            stage.daemon(name, [f"{address}:{PORT}"])
            for name, address in zip((victim, other), ADDRESSES, strict=True)
        )
        stage.introduce(self.victim, self.other)
        self._stage = stage
        self.talk: Talk

    async def __aenter__(self) -> Self:
        for host in self.hosts:
            await run("ip", "netns", "add", host)
        await self.plug_in()
        for host in self.hosts:
            await run("ip", "-n", host, "link", "set", "lo", "up")
        await self.configure()
        namespaces = (Path("/run/netns", self.hosts[0]), Path("/run/netns", self.hosts[1]))
        self.talk = prepare(self.victim, self.other, namespaces)
        for host, daemon in zip(self.hosts, self._daemons, strict=True):
            daemon.launcher = ("ip", "netns", "exec", host)
        await self._stage.start(*self._daemons)
        await self.talk.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if hasattr(self, "talk"):
            self.talk.stop()
        for daemon in self._daemons:
            if daemon.is_running:
                await daemon.stop()
        for host in self.hosts:
            await run("ip", "netns", "delete", host, check=False)

    @property
    def _daemons(self) -> tuple[DaemonProcess, DaemonProcess]:
        return self.victim, self.other

    async def ip(self, *command: str) -> None:
        """``ip`` on the victim's host."""
        await run("ip", "-n", self.hosts[0], *command)

    async def say(self, *command: str) -> None:
        """A command on the victim's host."""
        await run("ip", "netns", "exec", self.hosts[0], *command)

    async def plug_in(self) -> None:
        """A cable from an interface of one to one of the other; the other's is ready."""
        a, b = self.hosts
        await run("ip", "-n", a, "link", "add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", b)
        await run("ip", "-n", b, "address", "add", f"{ADDRESSES[1]}/24", "dev", "eth0")
        await run("ip", "-n", b, "link", "set", "eth0", "up")

    async def configure(self) -> None:
        """The victim's interface gets its address and is up."""
        await self.ip("address", "add", f"{ADDRESSES[0]}/24", "dev", "eth0")
        await self.ip("link", "set", "eth0", "up")
