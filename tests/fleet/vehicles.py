"""The daemons of a fleet, each with the files of its own folder, which are carried there as an operator does."""

from __future__ import annotations

import asyncio
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.waiting import until
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings, read_manifest
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import to_base64

NAMES = ("drone1", "drone2", "drone3")
RELAY = "relay"
END_S = 120.0
"""A daemon ends within a fraction of this."""


def loaded(folder: Path, name: str) -> Config:
    """A member's configuration as its daemon reads it."""
    return load_config(folder / name / f"{name}.toml", {})


def unasked(what: str) -> Secret:
    """In place of a passphrase: the keys of these tests have none."""
    raise AssertionError(what)


def create(
    folder: Path,
    settings: FleetSettings | None = None,
    *,
    relays: Sequence[Address] = (),
    at: Sequence[Address] = (),
    **counts: int,
) -> None:
    """A fleet of so many ``drones``, ``stations`` and ``observers``, with a key that is not encrypted.

    ``at``: addresses of the first ground stations.
    """
    roles = {"drones": MemberRole.VEHICLE, "stations": MemberRole.OPERATOR, "observers": MemberRole.OBSERVER}
    members = {role: counts.get(name, 0) for name, role in roles.items()}
    operations.init(folder, settings or FleetSettings(), members, (relays, at), None)


class Vehicles:
    """Daemons with their own folders. Files are copied there from the fleet's folder."""

    def __init__(self, folder: Path, drones: int) -> None:
        self._folder = folder
        self.fleet = folder / "fleet"
        settings = FleetSettings(swarm=True, drone_url=f"udpin:127.0.14.{{n}}:{free_port()}")
        create(self.fleet, settings, drones=drones, relays=[Address("127.0.0.1", free_port())])
        self._processes: dict[str, asyncio.subprocess.Process] = {}

    @property
    def pids(self) -> dict[str, int]:
        """The processes of the daemons that run."""
        return {name: process.pid for name, process in self._processes.items()}

    def place(self, name: str) -> Path:
        """The folder on the vehicle."""
        return self._folder / "on" / name

    def carry(self, name: str) -> None:
        """Replace the files on a vehicle."""
        for path in self.place(name).glob("*") if self.place(name).exists() else ():
            if path.suffix in (".toml", ".key"):
                path.unlink()
        shutil.copytree(self.fleet / name, self.place(name), dirs_exist_ok=True)

    async def start(self, name: str) -> None:
        """Start the daemon with the files on the vehicle."""
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = await asyncio.create_subprocess_exec(
                *end_with_parent(sys.executable, "-m", "uavlinkd", "run"),
                *("--config", str(self.place(name) / f"{name}.toml")),
                stdout=log,
                stderr=log,
            )

    async def stop(self, name: str) -> None:
        """End a daemon."""
        assert await end(self._processes.pop(name)) == 0

    async def renew(self, name: str, *, restart: bool) -> None:
        """Replace the files on a vehicle, and reload or restart the daemon."""
        self.carry(name)
        if restart:
            await self.stop(name)
            await self.start(name)
        else:
            log = self._folder / f"{name}.log"
            before = log.read_text().count("configuration_reloaded")
            self._processes[name].send_signal(signal.SIGHUP)
            await until(lambda: log.read_text().count("configuration_reloaded") > before)

    def status(self, name: str) -> dict[str, Any]:
        """The status of a daemon; empty if it does not answer."""
        try:
            return ask(self.place(name) / f"{name}.sock", "status")
        except ControlError:
            return {}

    def peers(self, name: str) -> dict[str, dict[str, Any]]:
        """The peers in the status of a daemon."""
        peers: dict[str, dict[str, Any]] = self.status(name).get("peers", {})
        return peers

    def up(self, name: str) -> set[str]:
        """The peers and members that are up, as a daemon says."""
        status = self.status(name)
        members = (status.get("relay") or {}).get("members", {})
        up = {peer for peer, facts in self.peers(name).items() if facts["state"] == "up"}
        return up | {member for member, facts in members.items() if facts["is_up"]}

    def drops(self, name: str) -> int:
        """The number of initiations of revoked members that a daemon dropped."""
        return int(self.status(name).get("drops", {}).get("certificate_revoked", 0))

    async def until_linked(self) -> None:
        """Wait until both ends of every pair are linked by the keys of the fleet's folder."""
        public = {member.name: to_base64(member.public_key) for member in read_manifest(self.fleet).current}

        def is_linked(name: str) -> bool:
            peers = self.peers(name)
            return all(
                other in peers and peers[other]["state"] == "up" and peers[other]["public_key"] == public[other]
                for other in NAMES
                if other != name
            )

        await until(lambda: all(map(is_linked, NAMES)))

    async def close(self) -> None:
        """End all daemons."""
        statuses = await asyncio.gather(*map(end, self._processes.values()))
        logs = {path.stem: path.read_text() for path in self._folder.glob("*.log")}
        for name, text in logs.items():
            print(f"--- {name}\n{text}")
        assert set(statuses) <= {0}
        assert not [name for name, text in logs.items() if "Traceback" in text]


async def end(process: asyncio.subprocess.Process) -> int:
    """End a daemon; its exit status. Kill it if it ignores SIGTERM."""
    if process.returncode is None:
        process.terminate()
    try:
        return await asyncio.wait_for(process.wait(), END_S)
    except TimeoutError:
        process.kill()
        return await process.wait()


@asynccontextmanager
async def flying(*, drones: int = len(NAMES), started: bool = True) -> AsyncIterator[Vehicles]:
    """Linked drones, which meet at a relay.

    Their folder has a short name, because the path of a Unix socket has to be short.
    """
    with tempfile.TemporaryDirectory(prefix="uavlinkd-") as folder:
        vehicles = Vehicles(Path(folder), drones)
        try:
            for name in (RELAY, *NAMES) if started else ():
                vehicles.carry(name)
                await vehicles.start(name)
            if started:
                await vehicles.until_linked()
            yield vehicles
        finally:
            await vehicles.close()
