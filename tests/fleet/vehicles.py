"""The daemons of a fleet, each with the files of its own folder, which are carried there as an operator does."""

from __future__ import annotations

import asyncio
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tests.waiting import until
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import parse_request
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config
from uavlinkd.fleet import enrolling, operations
from uavlinkd.fleet.enrolling import MemberFiles
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.fleet.signing import Identity
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import to_base64

NAMES = ("drone1", "drone2", "drone3")
RELAY = "relay"
ANY = Identity()
END_S = 120.0
"""A daemon ends within a fraction of this."""


def loaded(folder: Path, name: str) -> Config:
    """A member's configuration as its daemon reads it."""
    return load_config(folder / name / f"{name}.toml", {})


def unasked(what: str) -> Secret:
    """In place of a passphrase: the keys of these tests have none."""
    raise AssertionError(what)


def join(
    folder: Path,
    name: str,
    identity: Identity = ANY,
    *,
    replaces: bool = False,
    url: str | None = None,
    socket: str | None = None,
) -> None:
    """Enroll a member. Its files are in a folder beside the manifest, where an operator would not have them."""
    place = MemberFiles(folder / name / f"{name}.toml")
    line, _ = enrolling.request(name, place)
    _, fleet = operations.sign(folder, parse_request(line), identity, unasked, replaces=replaces)
    enrolling.finish(operations.line_of(fleet, name), place.config, None, url, (), socket)


def renew(folder: Path, *names: str) -> None:
    """Use the lines that `fleet sign NAME` prints, as the commands ask after a change of contacts."""
    fleet = read_manifest(folder)
    for name in names:
        config = folder / name / f"{name}.toml"
        enrolling.finish(operations.line_of(fleet, name), config, None, None, (), None)


def create(
    folder: Path,
    *,
    relays: Sequence[Address] = (),
    at: Sequence[Address] = (),
    swarm: bool = False,
    urls: Mapping[str, str] = MappingProxyType({}),
    socket: str | None = None,
    **counts: int,
) -> None:
    """A fleet of so many ``drones``, ``stations`` and ``observers``, with a key that is not encrypted.

    ``at``: addresses of the first ground stations. ``urls``: templates by kind of member, with its ``{n}``.
    """
    operations.init(folder, "x25519", None, swarm=swarm)
    kinds: tuple[tuple[str, MemberRole, str, Sequence[Address], int], ...] = (
        ("relays", MemberRole.RELAY, "relay", relays, len(relays)),
        ("stations", MemberRole.OPERATOR, "ground-station", at, counts.get("stations", 0)),
        ("drones", MemberRole.VEHICLE, "drone", (), counts.get("drones", 0)),
        ("observers", MemberRole.OBSERVER, "observer", (), counts.get("observers", 0)),
    )
    for kind, role, name, addresses, count in kinds:
        for number in range(1, count + 1):
            full = name if count == 1 and role is not MemberRole.VEHICLE else f"{name}{number}"
            url = urls[kind].replace("{n}", str(number)) if kind in urls else None
            join(folder, full, Identity(role, None, tuple(addresses[number - 1 : number])), url=url, socket=socket)


class Vehicles:
    """Daemons with their own folders. Files are copied there from the fleet's folder."""

    def __init__(self, folder: Path, drones: int) -> None:
        self._folder = folder
        self.fleet = folder / "fleet"
        urls = {"drones": f"udpin:127.0.14.{{n}}:{free_port()}"}
        create(self.fleet, drones=drones, relays=[Address("127.0.0.1", free_port())], swarm=True, urls=urls)
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
