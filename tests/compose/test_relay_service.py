"""The relay's service in configs/compose.relay.yaml, with members on the same host."""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose import images
from tests.compose.cluster import run, until
from tests.compose.containers import USER, health
from tests.processes.toml import to_toml
from tests.relay.core_member import CoreMember
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_port

pytestmark = pytest.mark.asyncio(loop_scope="module")

FILE = images.PROJECT / "configs" / "compose.relay.yaml"
INNER = b"\x40datagram"


class RelayService:
    def __init__(self, folder: Path, image: str) -> None:
        compose = images.compose_command()
        assert compose is not None
        self._compose = [*compose, "--project-name", f"uavlinkd-test-{os.getpid()}-service", "--file", str(FILE)]
        self._environ = {"UAVLINKD_IMAGE": image, "RELAY": str(folder / "relay"), "RESTART": "no"}
        self._folder = folder / "relay"
        private, port = keys.generate_private_key(), free_port()
        public = keys.decode_key(keys.public_key_text(private))
        self.members = [CoreMember(public, ("127.0.0.1", port)) for _ in range(2)]
        config = {
            "name": "relay",
            "private_key_file": "relay.key",
            "listen": [f"127.0.0.1:{port}"],
            "control_socket": "/run/uavlinkd/relay/control.sock",
            "member": [
                {"name": f"drone{number}", "public_key": keys.encode_key(member.key)}
                for number, member in enumerate(self.members)
            ],
        }
        self._folder.mkdir()
        keys.write_secret_file(self._folder / "relay.key", private)
        (self._folder / "relay.toml").write_text(to_toml(config))
        for path in (self._folder, *self._folder.iterdir()):
            shutil.chown(path, USER, USER)
        for path in (folder, folder.parent):
            path.chmod(0o755)

    async def up(self) -> None:
        await run(*self._compose, "up", "--detach", "--no-build", environ=self._environ)

    async def down(self) -> None:
        for member in self.members:
            member.close()
        print(await run(*self._compose, "logs", "--no-color", environ=self._environ, check=False))
        await run(*self._compose, "down", "--volumes", "--timeout", "1", environ=self._environ)

    async def container(self) -> str:
        return (await run(*self._compose, "ps", "-q", environ=self._environ)).strip()

    async def inspect(self, what: str) -> str:
        return (await run("docker", "inspect", "--format", what, await self.container())).strip()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def service(image: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[RelayService]:
    service = RelayService(tmp_path_factory.mktemp("service"), image)
    try:
        await service.up()
        yield service
    finally:
        await service.down()


async def test_members_meet_at_the_container(service: RelayService) -> None:
    """The relay sees their own addresses, not those of a NAT of Docker's."""
    one, other = service.members
    await one.bind(other.key)
    await other.bind(one.key)
    to_other, to_one = await one.until_bound(other.key), await other.until_bound(one.key)
    one.send(to_other, INNER)
    await other.until(lambda: other.data == [to_one.to_bytes(2, "big") + INNER])
    for member in service.members:
        assert (member.bounds[-1].host, member.bounds[-1].port) == member.address


async def test_container_is_healthy_confined_and_unprivileged(service: RelayService) -> None:
    """As the daemon's: no root, no capability, nothing to write to but the folder of its control socket."""
    container = await service.container()
    await until(lambda: health(container) == "healthy", "the relay is healthy")
    assert (await run("docker", "exec", container, "id", "-u")).strip() == str(USER)
    for path in ("/x", "/tmp/x", "/etc/uavlinkd/x", "/run/uavlinkd/x"):
        assert "Read-only file system" in await run("docker", "exec", container, "touch", path, check=False)
    capabilities = await run("docker", "exec", container, "grep", "CapEff", "/proc/1/status")
    assert int(capabilities.split()[1], 16) == 0
    assert await service.inspect("{{.HostConfig.Memory}} {{.HostConfig.PidsLimit}}") == f"{512 << 20} 64"
