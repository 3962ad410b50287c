"""Two hosts with two cables between them: network namespaces, each with an interface of LTE and one of a mesh."""

from __future__ import annotations

import asyncio
import os
import sys
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.compose.cluster import run
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults.talk import Talk, Voice, prepare
from tests.waiting import until
from uavlinkd.lab.child_processes import end_with_parent

PORT = 5790
LTE, MESH = "lte", "mesh"
_SUBNETS = {LTE: "10.213.81", MESH: "10.213.82"}
_numbers = count()


def address_of(network: str, place: int) -> str:
    """The IPv4 address of a host on a network: place 1 is the vehicle, 2 the ground station."""
    return f"{_SUBNETS[network]}.{place}"


class TwoNetworks:
    """A vehicle and a ground station that can reach each other along both networks.

    Change :attr:`vehicle` and :attr:`ground` and the interfaces before :meth:`start`.
    """

    def __init__(self, stage: Stage) -> None:
        name = f"uavnets-{os.getpid()}-{next(_numbers)}"
        self.hosts = (f"{name}-a", f"{name}-b")
        self._stage = stage
        self.vehicle, self.ground = (stage.daemon(name, [f"0.0.0.0:{PORT}"]) for name in ("drone0", "drone1"))
        self.talk: Talk
        psk = stage.psk()
        for daemon, other, place in ((self.vehicle, self.ground, 2), (self.ground, self.vehicle, 1)):
            daemon.config["network"] = [
                {"name": network, "interface": interface_of(network)} for network in (LTE, MESH)
            ]
            daemon.add_peer(other, [], psk)
            daemon.config["peer"][0]["addresses"] = [
                {"address": f"{address_of(network, place)}:{PORT}", "network": network} for network in (LTE, MESH)
            ]

    async def __aenter__(self) -> Self:
        for host in self.hosts:
            await run("ip", "netns", "add", host)
            await run("ip", "-n", host, "link", "set", "lo", "up")
        for network in (LTE, MESH):
            await self.plug_in(network)
            await self.configure(network)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if hasattr(self, "talk"):
            self.talk.stop()
        for daemon in (self.vehicle, self.ground):
            if daemon.is_running:
                await daemon.stop()
        for host in self.hosts:
            await run("ip", "netns", "delete", host, check=False)

    async def start(self, voice: type[Voice] = Voice) -> None:
        """Start both daemons with a talking client each, and wait until each hears the other."""
        namespaces = (Path("/run/netns", self.hosts[0]), Path("/run/netns", self.hosts[1]))
        self.talk = prepare(self.vehicle, self.ground, namespaces, voice)
        for host, daemon in zip(self.hosts, (self.vehicle, self.ground), strict=True):
            daemon.launcher = ("ip", "netns", "exec", host)
        await self._stage.start(self.vehicle, self.ground)
        await self.talk.start()

    async def ip(self, *command: str) -> None:
        """``ip`` on the vehicle."""
        await run("ip", "-n", self.hosts[0], *command)

    async def run(self, *command: str) -> None:
        """A command on the vehicle."""
        await run("ip", "netns", "exec", self.hosts[0], *command)

    async def check(self) -> tuple[int, str]:
        """What ``uavlinkd check`` says on the vehicle: its exit status and its output in one line."""
        process = await asyncio.create_subprocess_exec(
            *end_with_parent("ip", "netns", "exec", self.hosts[0], sys.executable, "-m", "uavlinkd", "check"),
            *("--config", str(self.vehicle.write_config())),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        assert process.returncode is not None
        return process.returncode, " ".join(output.decode().split())

    async def plug_in(self, network: str) -> None:
        """Make a cable between the hosts. The interface of the ground station is ready, not that of the vehicle."""
        vehicle, ground = self.hosts
        interface = interface_of(network)
        await run(
            *("ip", "-n", vehicle, "link", "add", interface, "type", "veth"),
            *("peer", "name", interface, "netns", ground),
        )
        await run("ip", "-n", ground, "address", "add", f"{address_of(network, 2)}/24", "dev", interface)
        await run("ip", "-n", ground, "link", "set", interface, "up")

    async def configure(self, network: str, place: int = 1) -> None:
        """Give the interface of the vehicle an address, and set it up."""
        interface = interface_of(network)
        await self.ip("address", "add", f"{address_of(network, place)}/24", "dev", interface)
        await self.ip("link", "set", interface, "up")

    async def until_present(self, network: str, *, is_present: bool = True) -> dict[str, Any]:
        """Wait until the vehicle sees the network, or until it does not. Returns its status."""
        status = await self.vehicle.until(
            lambda status: bool(status["networks"][network]["is_present"]) is is_present
        )
        seen: dict[str, Any] = status["networks"][network]
        return seen

    async def until_usable(self, *networks: str) -> None:
        """Wait until both daemons have logged that the paths on all these networks are usable now."""
        await until(lambda: all(self._is_usable(network) for network in networks))

    def _is_usable(self, network: str) -> bool:
        for daemon in (self.vehicle, self.ground):
            changes = [
                line["event"]
                for line in daemon.events()
                if line["event"] in ("path_usable", "path_down") and line["path"].startswith(_SUBNETS[network])
            ]
            if changes[-1:] != ["path_usable"]:
                return False
        return True

    async def until_path(self, network: str, daemon: DaemonProcess | None = None, place: int | None = None) -> None:
        """Wait until the vehicle, or another daemon, sends along this network; to this place there."""
        daemon = daemon or self.vehicle
        start = f"{_SUBNETS[network]}." if place is None else f"{address_of(network, place)}:"
        (peer,) = [peer["name"] for peer in daemon.config["peer"]]
        await daemon.until(
            lambda status: status["peers"][peer]["state"] == "up" and status["peers"][peer]["path"].startswith(start)
        )


def interface_of(network: str) -> str:
    """The name of the interface on both hosts."""
    return f"{network}0"
