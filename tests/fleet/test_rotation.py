"""Keys that change while the fleet flies: files arrive one by one, in any order, and no link is lost for good."""

from __future__ import annotations

import asyncio
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.harness import free_port
from tests.fleet.swarm import end
from uavlinkd.config import keys
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.fleet import operations as work
from uavlinkd.fleet.manifest import Kind, Settings, read_manifest

PATIENCE_S = 60.0
POLL_S = 0.02
NAMES = ("drone1", "drone2", "drone3")


class Vehicles:
    """Daemons with folders of their own, to which files are carried from the fleet's folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.fleet = folder / "fleet"
        settings = Settings(
            address_plan=f"127.0.14.{{n}}:{free_port()}", drone_url=f"udpin:127.0.14.{{n}}:{free_port()}", psk=True
        )
        work.init(self.fleet, settings, len(NAMES), 0, 0)
        self._processes: dict[str, asyncio.subprocess.Process] = {}

    def place(self, name: str) -> Path:
        """The folder on the vehicle."""
        return self._folder / "on" / name

    def carry(self, name: str) -> None:
        """Bring a vehicle its files, in place of those that it has."""
        for path in self.place(name).glob("*") if self.place(name).exists() else ():
            if path.suffix != ".sock":
                path.unlink()
        shutil.copytree(self.fleet / name, self.place(name), dirs_exist_ok=True)

    async def start(self, name: str) -> None:
        """Start the daemon with the files that are there."""
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "uavlinkd", "run", "--config", str(self.place(name) / f"{name}.toml")),
                stdout=log,
                stderr=log,
            )

    async def stop(self, name: str) -> None:
        """End it."""
        assert await end(self._processes.pop(name)) == 0

    async def renew(self, name: str, *, restart: bool) -> None:
        """Carry the files there, and have the daemon read them."""
        self.carry(name)
        if restart:
            await self.stop(name)
            await self.start(name)
        else:
            log = self._folder / f"{name}.log"
            before = log.read_text().count("configuration_reloaded")
            self._processes[name].send_signal(signal.SIGHUP)
            await _until(lambda: log.read_text().count("configuration_reloaded") > before)

    def status(self, name: str) -> dict[str, Any]:
        """What the daemon says; nothing where it does not answer."""
        try:
            return ask(self.place(name) / f"{name}.sock", "status")
        except ControlError:
            return {}

    def peers(self, name: str) -> dict[str, dict[str, Any]]:
        """What the daemon says about its peers."""
        peers: dict[str, dict[str, Any]] = self.status(name).get("peers", {})
        return peers

    async def until_linked(self, *, by_new_keys: bool = False) -> None:
        """Wait until every pair is linked at both ends; ``by_new_keys``: and no previous key is good any more."""
        public = {each.name: each.public_key for each in read_manifest(self.fleet).members}

        def is_linked(name: str) -> bool:
            peers = self.peers(name)
            return len(peers) == len(NAMES) - 1 and all(
                each["state"] == "up"
                and (not by_new_keys or (each["public_key"] == public[peer] and not each["accepts_previous_key"]))
                for peer, each in peers.items()
            )

        await _until(lambda: all(map(is_linked, NAMES)))

    async def close(self) -> None:
        """End all."""
        statuses = await asyncio.gather(*map(end, self._processes.values()))
        logs = {path.stem: path.read_text() for path in self._folder.glob("*.log")}
        for name, text in logs.items():
            print(f"--- {name}\n{text}")
        assert set(statuses) <= {0}
        assert not [name for name, text in logs.items() if "Traceback" in text]


async def _until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  other processes change it
            await asyncio.sleep(POLL_S)


@pytest.fixture
async def vehicles() -> AsyncIterator[Vehicles]:
    """Three drones, linked. Their folder's name is short, as the path of a Unix socket has to be."""
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


@pytest.mark.parametrize("order", [NAMES, NAMES[::-1], ("drone2", "drone1", "drone3")], ids=" ".join)
async def test_new_key_may_arrive_in_any_order(vehicles: Vehicles, order: Sequence[str]) -> None:
    """Whoever has the new files and whoever has the old, all are linked; in the end by the new key alone."""
    work.rotate(vehicles.fleet, "drone1")
    for name in order:
        await vehicles.renew(name, restart=name == "drone1")
        await vehicles.until_linked()
    await vehicles.until_linked(by_new_keys=True)


async def test_two_keys_may_change_at_a_time(vehicles: Vehicles) -> None:
    """Where both ends of a link change, each pair of keys that both may hold makes it."""
    work.rotate(vehicles.fleet, "drone1")
    work.rotate(vehicles.fleet, "drone2")
    for name in ("drone2", "drone3", "drone1"):
        await vehicles.renew(name, restart=name != "drone3")
        await vehicles.until_linked()
    await vehicles.until_linked(by_new_keys=True)


async def test_old_key_is_nobody_once_the_new_one_was_confirmed(vehicles: Vehicles) -> None:
    """Who has a copy of the old files is a stranger to daemons that had a session with the new key."""
    stolen = vehicles.fleet.parent / "stolen"
    shutil.copytree(vehicles.place("drone1"), stolen, ignore=shutil.ignore_patterns("*.sock"))
    work.rotate(vehicles.fleet, "drone1")
    for name in NAMES:
        await vehicles.renew(name, restart=name == "drone1")
    await vehicles.until_linked(by_new_keys=True)

    await vehicles.stop("drone1")
    shutil.rmtree(vehicles.place("drone1"))
    shutil.copytree(stolen, vehicles.place("drone1"))
    before = {name: strangers(vehicles, name) for name in ("drone2", "drone3")}
    await vehicles.start("drone1")
    await _until(lambda: all(strangers(vehicles, name) > amount for name, amount in before.items()))
    for name in before:
        assert vehicles.peers(name)["drone1"]["state"] != "up"


def strangers(vehicles: Vehicles, name: str) -> int:
    """How many calls by unknown keys that daemon dropped."""
    drops: dict[str, int] = vehicles.status(name).get("drops", {})
    return drops.get("unknown_peer", 0)


async def test_grace_ends(vehicles: Vehicles) -> None:
    """A peer that does not change its key in time is cut off, and the others are not."""
    work.rotate(vehicles.fleet, "drone1")
    path = vehicles.fleet / "drone2" / "drone2.toml"
    path.write_text("key_grace_s = 3\n" + path.read_text())
    await vehicles.stop("drone2")  # the time of grace can be told at the start alone
    vehicles.carry("drone2")
    await vehicles.start("drone2")
    await _until(lambda: vehicles.peers("drone2").get("drone1", {}).get("state") == "up")

    def is_cut_off() -> bool:
        peer = vehicles.peers("drone2")["drone1"]
        return peer["state"] != "up" and not peer["accepts_previous_key"]

    await _until(is_cut_off)
    await _until(lambda: vehicles.peers("drone2")["drone3"]["state"] == "up")


async def test_finishing_touches_no_session(vehicles: Vehicles) -> None:
    """Taking the old keys out of the files is no reason for a new handshake, at either end."""
    work.rotate(vehicles.fleet, "drone1")
    for name in NAMES:
        await vehicles.renew(name, restart=name == "drone1")
    await vehicles.until_linked(by_new_keys=True)
    work.finish_rotation(vehicles.fleet, "drone1")
    before = {name: vehicles.peers(name) for name in NAMES}
    for name in NAMES:
        await vehicles.renew(name, restart=False)
    for name in NAMES:
        for peer, each in vehicles.peers(name).items():
            assert each["state"] == "up"
            assert each["handshakes"] == before[name][peer]["handshakes"]
    assert not list(vehicles.fleet.rglob("*.previous.key"))


def test_files_of_every_moment_load(tmp_path: Path) -> None:
    """Whatever is done after what, each daemon takes its file."""
    for number, order in enumerate(permutations(("rotate", "finish", "add", "remove"))):
        fleet = tmp_path / str(number)
        work.init(fleet, Settings(psk=True), 3, 1, 0)
        for action in order:
            if action == "rotate":
                work.rotate(fleet, "drone1")
            elif action == "finish" and read_manifest(fleet).member("drone1").previous_public_key is not None:
                work.finish_rotation(fleet, "drone1")
            elif action == "add":
                work.add(fleet, "scout", Kind.DRONE)
            elif action == "remove":
                work.remove(fleet, "drone2")
        work.check(fleet, read_manifest(fleet).members)
        key = (fleet / "drone1" / "drone1.key").read_text()
        assert keys.public_key_text(key) == read_manifest(fleet).member("drone1").public_key
