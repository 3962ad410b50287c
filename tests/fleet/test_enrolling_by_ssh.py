"""`fleet enroll` by a real ssh: machines become members, their links come up, and what fails is named."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.fleet.ssh_hosts import SSHD, SshHosts
from tests.needs import need
from tests.waiting import PATIENCE_S, Stopwatch, until
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask

pytestmark = pytest.mark.long
PASSPHRASE = "correct horse battery staple"


class Laptop:
    """The operator's folder, in which the commands run, with the fleet and the passphrase in a file."""

    def __init__(self, folder: Path, hosts: SshHosts) -> None:
        self.folder = folder
        self.hosts = hosts
        self._environ = {"PATH": f"{hosts.client}:/usr/bin:/bin", "HOME": str(folder)}
        folder.mkdir()
        (folder / "passphrase").touch(mode=0o600)
        (folder / "passphrase").write_text(PASSPHRASE)

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        """What a command answers."""
        return subprocess.run(
            [sys.executable, "-m", "uavlinkd", *command.split(), "--passphrase-file", "passphrase"],
            cwd=self.folder,
            env=self._environ,
            capture_output=True,
            text=True,
            check=False,
        )

    def say(self, command: str) -> str:
        """What a command prints, which has to succeed."""
        done = self.run(command)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture
def laptop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laptop]:
    """An operator's machine with a fleet, from which ssh reaches v7 and v8."""
    need(SSHD is not None and shutil.which("ssh") is not None, "ssh and sshd: the package openssh-server")
    with SshHosts(tmp_path_factory.mktemp("h"), "v7", "v8") as hosts:
        laptop = Laptop(tmp_path_factory.mktemp("l") / "laptop", hosts)
        laptop.say("fleet init")
        wait(lambda: all(map(hosts.answers, hosts.names)))
        yield laptop


def wait(condition: Callable[[], bool]) -> None:
    """Wait for a condition outside of an event loop."""
    asyncio.run(until(condition))


@asynccontextmanager
async def running(*configs: Path) -> AsyncIterator[None]:
    """Daemons with these configurations."""
    daemons = [
        await asyncio.create_subprocess_exec(
            *end_with_parent(sys.executable, "-m", "uavlinkd", "run", "--config", str(config)), stderr=2
        )
        for config in configs
    ]
    try:
        yield
    finally:
        for daemon in daemons:
            daemon.terminate()
            assert await asyncio.wait_for(daemon.wait(), PATIENCE_S) == 0


def peers_up(config: Path) -> set[str]:
    """The peers whose links are up, as a daemon answers beside its configuration."""
    try:
        peers = ask(config.with_suffix(".sock"), "status")["peers"]
    except ControlError:
        return set()
    return {name for name, peer in peers.items() if peer["state"] == "up"}


async def test_one_command_enrolls_two_vehicles(laptop: Laptop) -> None:
    """One passphrase, and each vehicle has a link with the station. No file there changes but its own."""
    watch = Stopwatch()
    station = f"127.0.0.1:{free_port()}"
    laptop.say(f"fleet enroll gs --here --role operator --address {station} --url udpout:127.0.0.1:{free_port()}")
    began_s = watch.elapsed_s
    command = f"fleet enroll v7 v8 --id 7 --url udpout:127.0.0.1:{free_port()}"
    said = laptop.say(command)
    print(f"two vehicles were enrolled in {watch.elapsed_s - began_s:.1f} s")
    assert "v7 is a member of fleet" in said
    assert "system id 8" in said
    homes = {name: laptop.hosts.home(name) for name in ("v7", "v8")}
    assert [sorted(path.name for path in home.iterdir()) for home in homes.values()] == [
        ["v7.key", "v7.toml"],
        ["v8.key", "v8.toml"],
    ]
    configs = [laptop.folder / "gs.toml", *(home / f"{name}.toml" for name, home in homes.items())]
    async with running(*configs):
        await until(lambda: peers_up(configs[0]) == {"v7", "v8"})
        print(f"and linked {watch.elapsed_s - began_s:.1f} s after the command began")
        before = [config.read_bytes() for config in configs]
        assert laptop.say(command).count("is a member already: it keeps its key") == 2
        assert [config.read_bytes() for config in configs] == before


def test_failures_have_the_words_of_ssh_and_its_host(laptop: Laptop) -> None:
    """Each of them is what ssh or the host's shell says, with a remedy; nothing was signed."""
    laptop.say("fleet enroll relay --here --role relay --address relay.example.org:5790")
    hosts = laptop.hosts
    members = (laptop.folder / "fleet" / "fleet.toml").read_bytes()
    (hosts.commands("v7") / "uavlinkd").unlink()
    assert "not found\nInstall uavlinkd there" in laptop.run("fleet enroll v7").stderr
    (hosts.folder / "v7" / "authorized_keys").write_text("")
    error = laptop.run("fleet enroll v7").stderr
    assert "Permission denied (publickey" in error
    assert "First make `ssh v7` work" in error
    (hosts.folder / "known_hosts").write_text("")
    assert "Host key verification failed." in laptop.run("fleet enroll v8").stderr
    with (hosts.folder / "config").open("a") as config:
        config.write(f"Host v9\n    HostName 127.0.0.1\n    Port {free_port()}\n")
    assert "Connection refused" in laptop.run("fleet enroll v9").stderr
    assert "Could not resolve hostname" in laptop.run("fleet enroll v10.invalid").stderr
    assert (laptop.folder / "fleet" / "fleet.toml").read_bytes() == members
