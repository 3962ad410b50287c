"""Rotations of keys while the fleet flies: files arrive one by one, in any order, and every link recovers."""

from __future__ import annotations

import asyncio
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.swarm import end
from tests.waiting import until
from uavlinkd.config import keys
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings, MemberKind, read_manifest
from uavlinkd.fleet.transaction import check_members
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask

pytestmark = pytest.mark.long

NAMES = ("drone1", "drone2", "drone3")


class Vehicles:
    """Daemons with their own folders. Files are copied there from the fleet's folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.fleet = folder / "fleet"
        settings = FleetSettings(
            address_plan=f"127.0.14.{{n}}:{free_port()}", drone_url=f"udpin:127.0.14.{{n}}:{free_port()}", psk=True
        )
        operations.init(self.fleet, settings, len(NAMES), 0, 0)
        self._processes: dict[str, asyncio.subprocess.Process] = {}

    def place(self, name: str) -> Path:
        """The folder on the vehicle."""
        return self._folder / "on" / name

    def carry(self, name: str) -> None:
        """Replace the files on a vehicle."""
        for path in self.place(name).glob("*") if self.place(name).exists() else ():
            if path.suffix != ".sock":
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

    async def until_linked(self, *, by_new_keys: bool = False) -> None:
        """Wait until both ends of every pair are linked; ``by_new_keys``: and every previous key is revoked."""
        public = {member.name: member.public_key for member in read_manifest(self.fleet).members}

        def is_linked(name: str) -> bool:
            peers = self.peers(name)
            return len(peers) == len(NAMES) - 1 and all(
                status["state"] == "up"
                and (not by_new_keys or (status["public_key"] == public[peer] and not status["accepts_previous_key"]))
                for peer, status in peers.items()
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


@pytest.fixture
async def vehicles() -> AsyncIterator[Vehicles]:
    """Three linked drones. Their folder has a short name, because the path of a Unix socket has to be short."""
    with tempfile.TemporaryDirectory(prefix="uavlinkd-") as folder:
        vehicles = Vehicles(Path(folder))
        try:
            for name in NAMES:
                vehicles.carry(name)
                await vehicles.start(name)
            await vehicles.until_linked()
            yield vehicles
        finally:
            await vehicles.close()


@pytest.mark.parametrize(
    "order",
    [
        pytest.param(NAMES, id="first"),
        pytest.param(NAMES[::-1], id="last"),
        pytest.param(("drone2", "drone1", "drone3"), id="between"),
    ],
)
async def test_new_key_may_arrive_in_any_order(vehicles: Vehicles, order: Sequence[str]) -> None:
    """All links stay up while some daemons have the old files; at the end, only the new key is accepted."""
    operations.rotate(vehicles.fleet, "drone1")
    for name in order:
        await vehicles.renew(name, restart=name == "drone1")
        await vehicles.until_linked()
    await vehicles.until_linked(by_new_keys=True)


async def test_two_keys_may_change_at_a_time(vehicles: Vehicles) -> None:
    """If both ends of a link rotate, every combination of their old and new keys makes the link."""
    operations.rotate(vehicles.fleet, "drone1")
    operations.rotate(vehicles.fleet, "drone2")
    for name in ("drone2", "drone3", "drone1"):
        await vehicles.renew(name, restart=name != "drone3")
        await vehicles.until_linked()
    await vehicles.until_linked(by_new_keys=True)


async def test_old_key_is_refused_after_the_new_one_was_confirmed(vehicles: Vehicles) -> None:
    """A copy of the old files is an unknown peer to daemons that had a session with the new key."""
    stolen = vehicles.fleet.parent / "stolen"
    shutil.copytree(vehicles.place("drone1"), stolen, ignore=shutil.ignore_patterns("*.sock"))
    operations.rotate(vehicles.fleet, "drone1")
    for name in NAMES:
        await vehicles.renew(name, restart=name == "drone1")
    await vehicles.until_linked(by_new_keys=True)

    await vehicles.stop("drone1")
    shutil.rmtree(vehicles.place("drone1"))
    shutil.copytree(stolen, vehicles.place("drone1"))
    before = {name: strangers(vehicles, name) for name in ("drone2", "drone3")}
    await vehicles.start("drone1")
    await until(lambda: all(strangers(vehicles, name) > count for name, count in before.items()))
    for name in before:
        assert vehicles.peers(name)["drone1"]["state"] != "up"


def strangers(vehicles: Vehicles, name: str) -> int:
    """The number of handshakes with unknown keys that a daemon dropped."""
    drops: dict[str, int] = vehicles.status(name).get("drops", {})
    return drops.get("unknown_peer", 0)


async def test_grace_ends(vehicles: Vehicles) -> None:
    """A peer that does not rotate in time is cut off, and the others are not."""
    operations.rotate(vehicles.fleet, "drone1")
    path = vehicles.fleet / "drone2" / "drone2.toml"
    path.write_text("key_grace_s = 3\n" + path.read_text())
    await vehicles.stop("drone2")  # key_grace_s is read at the start only
    vehicles.carry("drone2")
    await vehicles.start("drone2")
    await until(lambda: vehicles.peers("drone2").get("drone1", {}).get("state") == "up")

    def is_cut_off() -> bool:
        peer = vehicles.peers("drone2")["drone1"]
        return peer["state"] != "up" and not peer["accepts_previous_key"]

    await until(is_cut_off)
    await until(lambda: vehicles.peers("drone2")["drone3"]["state"] == "up")


async def test_finishing_touches_no_session(vehicles: Vehicles) -> None:
    """Neither end makes a new handshake when the old keys are removed from the files."""
    operations.rotate(vehicles.fleet, "drone1")
    for name in NAMES:
        await vehicles.renew(name, restart=name == "drone1")
    await vehicles.until_linked(by_new_keys=True)
    operations.finish_rotation(vehicles.fleet, "drone1")
    before = {name: vehicles.peers(name) for name in NAMES}
    for name in NAMES:
        await vehicles.renew(name, restart=False)
    for name in NAMES:
        for peer, status in vehicles.peers(name).items():
            assert status["state"] == "up"
            assert status["handshakes"] == before[name][peer]["handshakes"]
    assert not list(vehicles.fleet.rglob("*.previous.key"))


def test_files_load_after_every_command(tmp_path: Path) -> None:
    """A daemon accepts its file after the commands in every order."""
    for number, order in enumerate(permutations(("rotate", "finish", "add", "remove"))):
        fleet = tmp_path / str(number)
        operations.init(fleet, FleetSettings(psk=True), 3, 1, 0)
        for action in order:
            if action == "rotate":
                operations.rotate(fleet, "drone1")
            elif action == "finish" and read_manifest(fleet).member("drone1").previous_public_key is not None:
                operations.finish_rotation(fleet, "drone1")
            elif action == "add":
                operations.add(fleet, "scout", MemberKind.DRONE)
            elif action == "remove":
                operations.remove(fleet, "drone2")
        check_members(fleet, read_manifest(fleet).members)
        key = (fleet / "drone1" / "drone1.key").read_text()
        assert keys.public_key_text(key) == read_manifest(fleet).member("drone1").public_key
