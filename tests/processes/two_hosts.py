"""Two hosts (network namespaces) with a cable for each network between them, and a talking daemon on each."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

from tests.faults.talk import Talk, prepare
from tests.namespaces import Namespace
from tests.processes.harness import Stage

PORT = 5790
LTE, MESH, ONLY = "lte", "mesh", "eth"
_SUBNETS = {LTE: "10.213.81", MESH: "10.213.82", ONLY: "10.213.77"}


def address_of(network: str, place: int) -> str:
    """The IPv4 address of a host on a network: place 1 is the vehicle, 2 the ground station."""
    return f"{_SUBNETS[network]}.{place}"


def interface_of(network: str) -> str:
    """The name of the interface on both hosts."""
    return f"{network}0"


class TwoHosts:
    """A vehicle and a ground station that can reach each other along each network.

    With several networks, these are in the configurations. Change :attr:`vehicle`, :attr:`ground` and the interfaces
    before :meth:`start`.
    """

    def __init__(
        self, stage: Stage, networks: Sequence[str] = (LTE, MESH), names: tuple[str, str] = ("drone0", "drone1")
    ) -> None:
        self.hosts = Namespace(), Namespace()
        self.talk: Talk
        self._stage = stage
        self._networks = networks
        self.vehicle, self.ground = self._daemons = (
            stage.daemon(names[0], [f"0.0.0.0:{PORT}"]),
            stage.daemon(names[1], [f"0.0.0.0:{PORT}"]),
        )
        psk = stage.psk()
        for place, host, daemon in zip((1, 2), self.hosts, self._daemons, strict=True):
            daemon.launcher = host.launcher
            daemon.add_peer(self._daemons[2 - place], [], psk)
            other = {network: f"{address_of(network, 3 - place)}:{PORT}" for network in networks}
            if len(networks) > 1:
                daemon.config["network"] = [{"name": name, "interface": interface_of(name)} for name in networks]
                daemon.config["peer"][0]["addresses"] = [
                    {"address": address, "network": name} for name, address in other.items()
                ]
            else:
                daemon.config["peer"][0]["addresses"] = list(other.values())

    async def __aenter__(self) -> Self:
        for host in self.hosts:
            host.open()
        for network in self._networks:
            self.plug_in(network)
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
            host.close()

    async def start(self) -> None:
        """Start both daemons with a talking client each, and wait until each hears the other."""
        self.talk = prepare(self.vehicle, self.ground, (self.hosts[0].path, self.hosts[1].path))
        await self._stage.start(*self._daemons)
        await self.talk.start()

    # The vehicle's host.

    def ip(self, line: str) -> None:
        self.hosts[0].ip(line)

    def run(self, script: str) -> None:
        """A shell script there."""
        self.hosts[0].run("sh", "-euc", script)

    def plug_in(self, network: str) -> None:
        """Make a cable between the hosts, and configure the interfaces of both."""
        (vehicle, ground), interface = self.hosts, interface_of(network)
        vehicle.ip(f"link add {interface} type veth peer name {interface} netns {ground.name}")
        ground.ip(f"address add {address_of(network, 2)}/24 dev {interface}", f"link set {interface} up")
        vehicle.ip(f"address add {address_of(network, 1)}/24 dev {interface}", f"link set {interface} up")

    # What the daemons say.

    async def until_present(self, network: str, *, is_present: bool = True) -> dict[str, Any]:
        """Wait until the vehicle sees the network, or until it does not. Returns its status."""
        status = await self.vehicle.until(
            lambda status: bool(status["networks"][network]["is_present"]) is is_present
        )
        seen: dict[str, Any] = status["networks"][network]
        return seen

    async def until_path(self, network: str) -> None:
        """Wait until the vehicle sends along this network."""
        start = f"{_SUBNETS[network]}."
        (peer,) = [peer["name"] for peer in self.vehicle.config["peer"]]
        await self.vehicle.until(
            lambda status: status["peers"][peer]["state"] == "up" and status["peers"][peer]["path"].startswith(start)
        )
