"""A fleet in containers, by a real `docker compose up` of compose.yaml: links, outages, and a man in the middle."""

from __future__ import annotations

import os
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from tests.compose import images, outages
from tests.compose.cluster import Cluster, Conversation, run, until
from tests.needs import need
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.ops.control import ControlError, ask

pytestmark = pytest.mark.asyncio(loop_scope="module")

USER = 10001
"""Of the daemons in the image."""
NETWORK = f"10.{64 + os.getpid() % 128}"
"""The first half of the addresses. Another checkout may test on the same machine."""
SUBNET, MITM_SUBNET = f"{NETWORK}.0.0/24", f"{NETWORK}.1.0/24"


class Containers(Cluster):
    """The services of compose.yaml."""

    cut_s = outages.OUTAGE_S

    def __init__(self, folder: Path, image: str, *, mitm: bool = False) -> None:
        self._folder = folder
        self._project = f"uavlinkd-test-{os.getpid()}{'-mitm' if mitm else ''}"
        self._mitm = mitm
        compose = images.compose_command()
        assert compose is not None
        self._compose = [*compose, "--project-name", self._project, "--file", str(images.HERE / "compose.yaml")]
        if mitm:
            self._compose += ["--profile", "mitm"]
        self._environ = {
            "UAVLINKD_IMAGE": image,
            "FLEET": str(folder / "fleet"),
            "SUBNET": MITM_SUBNET if mitm else SUBNET,
            "RESTART": "no",  # here it is the test that starts what it stopped
        }
        self._pids: dict[str, int] = {}
        self._logs = ""

    async def open(self) -> None:
        """Make the fleet, and start everything."""
        settings = FleetSettings(
            address_plan="{name}:5790",
            psk=True,
            control_socket="/run/uavlinkd/control.sock",
            ground_station_url="udpin:127.0.0.1:14550",
        )
        fleet = self._folder / "fleet"
        operations.init(fleet, settings, 3, 1, 0)
        if self._mitm:
            _replace(fleet / "drone1" / "drone1.toml", '"ground-station:5790"', '"mitm:5801"')
            _replace(fleet / "ground-station" / "ground-station.toml", '"drone1:5790"', '"mitm:5802"')
        for path in (fleet, *fleet.rglob("*")):
            os.chown(path, USER, USER)
        for path in (fleet, *fleet.parents):
            if path == self._folder.parent:
                break
            path.chmod(0o755)
        await self.compose("up", "--detach", "--no-build")
        await self._look_up()

    async def close(self) -> None:
        """Stop and remove everything but the image."""
        self._logs = await self.compose("logs", "--no-color", check=False)
        await self.compose("down", "--volumes", "--timeout", "1", check=False)

    async def compose(self, *arguments: str, check: bool = True) -> str:
        """One compose command."""
        return await run(*self._compose, *arguments, environ=self._environ, check=check)

    async def container(self, service: str) -> str:
        """The container's id, running or not."""
        filters = (f"com.docker.compose.project={self._project}", f"com.docker.compose.service={service}")
        containers = await run("docker", "ps", "-aq", *(f"--filter=label={label}" for label in filters))
        assert len(containers.split()) == 1, f"{service} has the containers: {containers}"
        return containers.strip()

    async def inspect(self, service: str, what: str) -> str:
        """A fact about a service's container, as a template names it."""
        return (await run("docker", "inspect", "--format", what, await self.container(service))).strip()

    async def _look_up(self, *names: str) -> None:
        for name in names or (*self.names, *(("mitm",) if self._mitm else ())):
            self._pids[name] = int(await self.inspect(name, "{{.State.Pid}}"))

    def namespace_of(self, name: str) -> Path:
        return Path(f"/proc/{self._pids[name]}/ns/net")

    def control_socket_of(self, name: str) -> Path:
        return Path(f"/proc/{self._pids[name]}/root/run/uavlinkd/control.sock")

    async def stop(self, name: str) -> None:
        await run("docker", "stop", await self.container(name))
        assert await self.inspect(name, "{{.State.ExitCode}}") == "0"

    async def kill(self, name: str) -> None:
        await run("docker", "kill", await self.container(name))

    async def start(self, name: str) -> None:
        await run("docker", "start", await self.container(name))
        await self._look_up(name)

    async def pause(self, name: str) -> None:
        await run("docker", "pause", await self.container(name))

    async def resume(self, name: str) -> None:
        await run("docker", "unpause", await self.container(name))

    async def cut(self, name: str) -> None:
        await run("docker", "network", "disconnect", f"{self._project}_air", await self.container(name))

    async def join(self, name: str, *, elsewhere: bool = False) -> None:
        address = ["--ip", f"{NETWORK}.0.77"] if elsewhere else []
        await run(
            *("docker", "network", "connect", "--alias", name, *address),
            *(f"{self._project}_air", await self.container(name)),
        )

    def health(self, container: str) -> str:
        """What a container's health check says."""
        command = ("docker", "inspect", "--format", "{{.State.Health.Status}}", container)
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    def logs(self) -> str:
        return self._logs

    # The man in the middle.

    def ask_mitm(self, request: str) -> dict[str, Any]:
        """What the man in the middle answers; nothing where he is not there."""
        try:
            return ask(Path(f"/proc/{self._pids['mitm']}/root/run/uavlinkd/mitm.sock"), request)
        except ControlError:
            return {}

    def interventions(self, attack: str) -> int:
        """How often an attack did something."""
        counts: dict[str, int] = self.ask_mitm("statistics").get("interventions", {})
        return sum(count for name, count in counts.items() if name.partition(":")[0] == attack)


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def image() -> str:
    """The image of the code as it is, built once."""
    reason = images.why_not()
    need(reason is None, str(reason))
    return images.build()


@asynccontextmanager
async def opened(cluster: Containers) -> AsyncIterator[Containers]:
    """A cluster from `up` to `down`."""
    try:
        await cluster.open()
        await cluster.until_linked()
        yield cluster
    finally:
        await cluster.close()
        print(cluster.logs())


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def containers(image: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Containers]:
    """Three drones and a ground station, for all tests of this file."""
    async with opened(Containers(tmp_path_factory.mktemp("fleet"), image)) as cluster:
        yield cluster


@pytest_asyncio.fixture(loop_scope="module")
async def cluster(containers: Containers) -> Containers:
    """The same, all linked."""
    await until(containers.are_all_linked, "all links are up")
    return containers


async def test_frames_reach_all_others_once(cluster: Containers) -> None:
    """What each vehicle's client says comes to each other's once, byte for byte; the autopilots beside them fly."""
    await outages.check_frames(cluster)

    def from_endpoint(name: str) -> int:
        status = cluster.status(name)
        assert status is not None
        (endpoint,) = status["endpoints"].values()
        return int(endpoint["frames_received"])

    for name in ("drone1", "drone2"):  # drone3's container is started again in other tests, its autopilot's is not
        before = from_endpoint(name)
        await until(lambda name=name, before=before: from_endpoint(name) > before, f"{name}'s autopilot flies")  # type: ignore[misc]


async def test_containers_are_healthy_confined_and_unprivileged(cluster: Containers) -> None:
    """The health check passes on live links; the daemon is not root, and its root file system is read-only."""

    drone = await cluster.container("drone1")
    await until(lambda: cluster.health(drone) == "healthy", "drone1 is healthy")
    assert (await run("docker", "exec", drone, "id", "-u")).strip() == str(USER)
    for path in ("/x", "/tmp/x", "/etc/uavlinkd/x", "/opt/uavlinkd/x"):
        assert "Read-only file system" in await run("docker", "exec", drone, "touch", path, check=False)
    capabilities = await run("docker", "exec", drone, "grep", "CapEff", "/proc/1/status")
    assert int(capabilities.split()[1], 16) == 0


@pytest.mark.long
@pytest.mark.parametrize("outage", outages.OUTAGES.values(), ids=outages.OUTAGES)
async def test_outage_ends_in_time_and_disturbs_no_other_link(
    cluster: Containers, outage: Callable[[Cluster], Awaitable[float]]
) -> None:
    """A container that was gone is linked again two seconds after it can be reached; the others lose no frame."""
    await outage(cluster)


ATTACKS = (
    *("bit-flip,share=0.2", "truncate,share=0.2", "extend,share=0.2", "splice,share=0.2", "tamper-tag,share=0.2"),
    *("alter-frame,share=0.2", "counter-jump,share=0.2", "replay-data", "duplicate", "reflect", "raw-mavlink"),
    *("forge-data", "reorder", "stranger-scan"),
)
"""On the data of a link that is up: some lose genuine frames, none may add one."""


@pytest.mark.long
async def test_man_in_the_middle_gets_nothing_accepted(image: str, tmp_path: Path) -> None:
    """Through a set of attacks between drone1 and the ground station, every frame arrives at most once and unaltered.

    Then it passes everything, and everything arrives.
    """
    async with opened(Containers(tmp_path, image, mitm=True)) as cluster:
        conversation = Conversation(cluster, ("drone1", "ground-station"))
        try:
            await conversation.open()
            for attack in ATTACKS:
                await _attack(cluster, conversation, attack)
            cluster.ask_mitm("attack none")
            await until(cluster.are_all_linked, "all links are up")
            conversation.forget()
            await conversation.say_many(200)
            await conversation.check()
        finally:
            conversation.close()
        for name in ("drone1", "ground-station"):
            status = cluster.status(name)
            assert status is not None
            assert sum(status["drops"].values()) + sum(sum(p["drops"].values()) for p in status["peers"].values())


async def _attack(cluster: Containers, conversation: Conversation, attack: str) -> None:
    name = attack.partition(",")[0]
    assert cluster.ask_mitm(f"attack {attack}"), f"{name} is not an attack"
    before = conversation.said

    def has_intervened() -> bool:
        conversation.say()
        return cluster.interventions(name) >= 20

    await until(has_intervened, f"{name} intervened")
    conversation.check_nothing_else()
    print(f"{name}: {cluster.interventions(name)} interventions in {conversation.said - before} frames of each")
