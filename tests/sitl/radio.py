"""The emulated radio between the two ends, ``uavlink-mitm`` in its own process, and the conditions of its link."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.processes.toml import to_toml
from tests.processes.udp import Sockaddr, shown
from tests.waiting import PATIENCE_S
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask


@dataclass(frozen=True, slots=True)
class Condition:
    """The impairments of both directions. ``radio`` has the keys of a ``[[radio]]`` section of ``uavlink-mitm``."""

    name: str
    radio: Mapping[str, object] = field(default_factory=dict)
    link: Mapping[str, object] = field(default_factory=dict)
    """Keys of the daemons' ``[link]`` section."""


CLEAN = Condition("clean")
CONDITIONS = (
    CLEAN,
    Condition("loss30", {"loss": 0.3}),
    Condition("slow", {"bits_per_s": 250_000.0}, {"budget_bits_s": 250_000}),
    Condition("delay", {"delay_s": 0.03, "jitter_s": 0.04}),
)
BY_NAME = {condition.name: condition for condition in CONDITIONS}


class Radio:
    """A radio for several links. Add links with :meth:`connect`, then :meth:`start`."""

    def __init__(self, folder: Path, impairments: Mapping[str, object], seed: int = 0, name: str = "radio") -> None:
        self._path = folder / f"{name}.toml"
        self._socket = folder / f"{name}.sock"
        self._config: dict[str, Any] = {"seed": seed, "control_socket": self._socket.name, "peer": [], "link": []}
        self._config["radio"] = [{"direction": "both", **impairments}] if impairments else []
        self._process: asyncio.subprocess.Process | None = None

    def connect(self, name: str, near: Sockaddr, far: Sockaddr) -> tuple[Sockaddr, Sockaddr]:
        """Add a link from ``near`` to ``far``.

        Returns the address at which near reaches far, and the address at which far reaches near.
        """
        faces: Sequence[Sockaddr] = [("127.0.0.1", free_port()) for _ in range(2)]
        ends = ((name, near), (f"{name}-ground", far))
        self._config["peer"] += [{"name": end, "address": shown(address)} for end, address in ends]
        self._config["link"].append({"between": [name, f"{name}-ground"], "listen": [shown(face) for face in faces]})
        return faces[0], faces[1]

    async def start(self) -> None:
        """Start the process, and wait until it answers."""
        self._path.write_text(to_toml({key: value for key, value in self._config.items() if value != []}))
        self._process = await asyncio.create_subprocess_exec(
            *end_with_parent(sys.executable, "-m", "uavlinkd.lab.mitm", "--config", str(self._path)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with suppress(ControlError):
                    await self.ask("statistics")
                    return
                await asyncio.sleep(0.02)

    async def ask(self, request: str) -> dict[str, Any]:
        """Send a request to the control socket. Raises ControlError if there is no answer."""
        answer = await asyncio.to_thread(ask, self._socket, request)
        assert "refused" not in answer, answer
        return answer

    async def cut(self) -> None:
        """Drop every datagram in both directions."""
        await self.ask("attack drop")

    async def lose(self, share: float) -> None:
        """Drop a share of the datagrams in both directions."""
        await self.ask(f"attack drop,share={share:g}")

    async def restore(self) -> None:
        """End :meth:`cut` and :meth:`lose`."""
        await self.ask("attack none")

    async def stop(self) -> None:
        """End the process."""
        if self._process is not None and self._process.returncode is None:
            self._process.terminate()
            await self._process.wait()
