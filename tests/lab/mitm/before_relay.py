"""Two real daemons and a real relay, with the man in the middle on the paths between each daemon and the relay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from uavlinkd.config.keys import decode_key
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports

RELAY: Final = "vps"
DRONES: Final = ("drone0", "drone1")


class RelayProcess(DroneProcess):
    """``uavlinkd relay`` with these members."""

    command = "relay"

    def configure_members(self, link: Mapping[str, object], members: Mapping[str, str]) -> None:
        """Write the configuration. ``members``: public keys by name."""
        tables = [("[link]", link)]
        tables += [("[[member]]", {"name": name, "public_key": key}) for name, key in members.items()]
        self.write(tables)


class MiddleBeforeRelay(MiddleHere):
    """A proxy on each path to the relay, along two paths; none on a way between members."""

    def __init__(self, log: Path | None, seed: int) -> None:
        super().__init__((*DRONES, RELAY), log, seed, paths=2)
        self.ports: dict[Direction, int] = {
            direction: port
            for direction, port in self.ports.items()
            if RELAY in (direction.sender, direction.receiver)
        }


class StageBeforeRelay(DaemonStage):
    """The daemons know no address of each other. ``link``: of the daemons and of the relay."""

    def __init__(
        self, folder: Path, middle: MiddleBeforeRelay, link: Mapping[str, object], *, rate_hz: float
    ) -> None:
        super().__init__(DRONES, folder, middle, link, rate_hz=rate_hz)
        port, unused = free_ports(2)
        self._relay = RelayProcess(RELAY, folder / RELAY, port, unused)
        self._relay.configure_members(link, {name: drone.public_key for name, drone in self.drones.items()})

    async def open(self) -> None:
        await self._relay.start()
        await super().open()

    async def close(self) -> None:
        await super().close()
        await self._relay.stop()

    def attacked(self) -> tuple[dict[str, int], dict[str, bytes]]:
        ports, keys = super().attacked()
        return {**ports, RELAY: self._relay.port}, {**keys, RELAY: decode_key(self._relay.public_key)}

    def addresses(self, one: str, other: str) -> list[object]:
        """None: the relay finds the peer."""
        del one, other
        return []

    def relays(self, name: str) -> list[dict[str, Any]]:
        """The relay, in front of the man in the middle."""
        ports = [port for direction, port in self.middle.ports.items() if direction[:2] == (name, RELAY)]
        addresses = [f"{HOST}:{port}" for port in ports]
        return [{"name": RELAY, "public_key": self._relay.public_key, "addresses": addresses}]
