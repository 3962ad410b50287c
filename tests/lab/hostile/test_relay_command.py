"""The command ``uavlink-mitm relay``: a process between two real daemons."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from tests.processes.fleet import relay_for
from tests.processes.frames import frame, heartbeat
from tests.processes.harness import Stage, secret_forms
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client, Sockaddr, pour
from tests.waiting import until
from uavlinkd.cli import mitm as main
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.ops.control import ask

MARKER: Final = 1 << 20
"""The number of the frame behind the first signs of life."""


class Flow(NamedTuple):
    """Frames of one system: the client that sends them, its endpoint, and the client that receives them."""

    system: int
    source: Client
    into: Sockaddr
    sink: Client

    async def pour(self, numbers: Iterable[int], window_bytes: int = 32768) -> None:
        """Send frames with these numbers. Assert that they arrive, and nothing else."""
        frames = [frame(number, self.system) for number in numbers]
        await pour(frames, self.source, self.into, self.sink, window_bytes=window_bytes)
        self.sink.clear()


class RelayedPair:
    """``one`` has the autopilot's client, ``other`` the ground station's. Neither has an address of the other.

    ``link`` is the section of both.
    """

    def __init__(self, stage: Stage, relay: DaemonProcess, **link: object) -> None:
        self.one, self.other = stage.daemon("drone0"), stage.daemon("drone1")
        self._stage = stage
        psk = stage.psk()
        for member, peer in ((self.one, self.other), (self.other, self.one)):
            member.config["link"].update(link)
            member.add_peer(peer, [], psk)
            member.config["relay"] = [
                {"name": relay.name, "public_key": relay.public_key, "addresses": [relay.address]}
            ]
            relay.config["member"].append({"name": member.name, "public_key": member.public_key})

    async def start(self) -> None:
        """Return when they are linked, and frames pass in both directions."""
        self._into = [daemon.add_endpoint("client") for daemon in (self.one, self.other)]
        self._clients = [await self._stage.client() for _ in self._into]
        await self._stage.start(self.one, self.other)
        for end in self.ends():
            end.source.send(heartbeat(end.system), end.into)  # makes the client known to its daemon
        for end in self.ends():
            while not end.sink.received:
                end.source.send(heartbeat(end.system), end.into)
                with suppress(TimeoutError):
                    await end.sink.until(lambda sink=end.sink: bool(sink.received), 0.2)  # type: ignore[misc]
        for end in self.ends():
            marker = frame(MARKER, end.system)
            end.source.send(marker, end.into)
            await end.sink.until_received(marker)
            end.sink.clear()

    def ends(self) -> tuple[Flow, Flow]:
        """Both directions."""
        (one, two), (into_one, into_two) = self._clients, self._into
        return Flow(1, one, into_one, two), Flow(2, two, into_two, one)


pytestmark = pytest.mark.usefixtures("undone_settings")

_COMMAND = "import sys; from uavlinkd.cli import mitm; sys.exit(mitm())"
SOME = ("relay-frames", "relay-invent", "relay-lie", "bit-flip,beside=true", "replay-data,copies=2")
"""Attacks that withhold nothing."""


@asynccontextmanager
async def _running(relay: DaemonProcess, *arguments: str) -> AsyncIterator[Path]:
    """The command with a relay's file. Its control socket. At the end it stops on SIGTERM, and said no secret."""
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-c", _COMMAND, "relay"),
        f"--config={relay.write_config()}",
        *arguments,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        yield relay.folder / "control.sock"
    finally:
        process.send_signal(signal.SIGTERM)
        _, errors = await process.communicate()
    assert process.returncode == 0
    assert b"Traceback" not in errors
    assert not [form for form in secret_forms(relay.private_key) if form in errors.decode()]


@pytest.mark.long
async def test_process_between_two_daemons(capsys: pytest.CaptureFixture[str]) -> None:
    """Without an attack frames pass. With attacks nothing false is accepted, and each attack is counted."""
    async with Stage() as stage:
        relay = relay_for(stage)
        pair = RelayedPair(stage, relay)
        async with _running(relay, "--seed=3") as control:
            await pair.start()
            for flow in pair.ends():
                await flow.pour(range(200))
            assert await _statistics(control, "interventions") == {}
            said = await asyncio.to_thread(
                main, ["relay", f"--config={relay.config_file}", f"--ask=attack {' '.join(SOME)}"]
            )
            assert said == 0
            for flow in pair.ends():
                await flow.pour(range(200, 2000), window_bytes=4096)
            wanted = {text.partition(",")[0] for text in SOME}
            await until(lambda: wanted <= {text.partition(":")[0] for text in _interventions(control)})
            for flow in pair.ends():
                await flow.pour([5000])
            drops = (await pair.one.status())["peers"]["drone1"]["drops"]
            assert drops.keys() >= {"bad_tag", "duplicate"}
            daemon_drops = (await pair.one.status())["drops"]
            assert daemon_drops.keys() >= {"frames_not_allowed", "relay_unknown_handle"}
    assert capsys.readouterr().out.count("attacks") == 1


async def _statistics(control: Path, key: str) -> Any:
    return (await asyncio.to_thread(ask, control, "statistics"))[key]


def _interventions(control: Path) -> dict[str, int]:
    counts: dict[str, int] = ask(control, "statistics")["interventions"]
    return counts
