"""A daemon as a process of its own, with its files in a folder: for the demo and the evaluation."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from random import SystemRandom
from typing import Any

from uavlinkd.checker import interpreter
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.config.keys import decode_key, generate_private_key, public_key_text, write_secret_file

STOP_S = 5.0
"""How long a daemon may take to end when it is asked to."""


_UNASSIGNED = 10240, 32768
"""The ports below Linux's default for net.ipv4.ip_local_port_range."""


class DroneError(Exception):
    """A daemon that does not do its work. The message is for a person."""


class DroneProcess:
    """One drone's daemon. Configure it, then start it; it may be killed and started again.

    Args:
        name: its name here and for its peers.
        folder: for its files; made here.
        port: where peers reach it, on loopback.
        endpoint_port: where its autopilot sends to.
    """

    def __init__(self, name: str, folder: Path, port: int, endpoint_port: int) -> None:
        self.name = name
        self.folder = folder
        self.port = port
        self.endpoint_port = endpoint_port
        self.socket = folder / "control.sock"
        self.log = folder / "daemon.log"
        self.status: dict[str, Any] = {}
        self._process: asyncio.subprocess.Process | None = None
        folder.mkdir()
        self._private = generate_private_key()
        write_secret_file(folder / "drone.key", self._private)
        self.public_key = public_key_text(self._private)

    @property
    def private_key(self) -> bytes:
        """What an attacker has who captured this drone."""
        return decode_key(self._private)

    @property
    def pid(self) -> int:
        """Of the process."""
        assert self._process is not None
        return self._process.pid

    def configure(self, link: Mapping[str, object], peers: Sequence[Mapping[str, object]]) -> None:
        """Write the configuration: the ``[link]`` section, and each ``[[peer]]``."""
        top = {
            "name": self.name,
            "private_key_file": "drone.key",
            "listen": [f"127.0.0.1:{self.port}"],
            "control_socket": self.socket.name,
        }
        endpoint = {"name": "autopilot", "url": f"udpin:127.0.0.1:{self.endpoint_port}"}
        tables = [("", top), ("[link]", link), ("[[endpoint]]", endpoint), *(("[[peer]]", peer) for peer in peers)]
        lines = [
            f"{name}\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in t.items()) for name, t in tables
        ]
        (self.folder / "drone.toml").write_text("\n".join(lines).lstrip(), encoding="utf-8")

    def as_peer(self, address: str, psk_file: str, **settings: object) -> dict[str, object]:
        """What another drone's configuration says of this one: it is trusted, unless ``settings`` say otherwise."""
        return {
            "name": self.name,
            "public_key": self.public_key,
            "addresses": [address],
            "psk_file": psk_file,
            "role": "all",
            "system_ids": "all",
            **settings,
        }

    def share_psk(self, psk: str, file: str) -> None:
        """Write a key that is shared with a peer."""
        write_secret_file(self.folder / file, psk)

    async def start(self) -> None:
        """Start the process. Its log goes on where one before it ended."""
        with self.log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *(*interpreter(), "-m", "uavlinkd", "run", "--config", str(self.folder / "drone.toml")),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End the process, gently first."""
        if self._process is None or self._process.returncode is not None:
            return
        self._process.send_signal(number)
        try:
            await asyncio.wait_for(self._process.wait(), STOP_S)
        except TimeoutError:
            self._process.kill()
            await self._process.wait()

    async def ask(self) -> dict[str, Any]:
        """Ask the daemon how it is; empty, or what it said last, while it does not listen yet.

        Raises:
            DroneError: when the process has ended.
        """
        if self._process is not None and self._process.returncode is not None:
            said = "\n".join(self.last_lines(5))
            raise DroneError(f"the daemon of {self.name} ended with status {self._process.returncode}:\n{said}")
        with suppress(ControlError):  # not listening yet
            self.status = await asyncio.to_thread(ask, self.socket, "status")
        return self.status

    @property
    def peer_statuses(self) -> list[dict[str, Any]]:
        """What it says of its peers; empty before it has answered."""
        return list(self.status.get("peers", {}).values())

    def is_ready(self) -> bool:
        """Whether its links are up and its autopilot is there."""
        programs = self.status.get("endpoints", {}).get("autopilot", {}).get("programs", {})
        return bool(programs) and all(each["state"] == "up" for each in self.peer_statuses)

    def last_lines(self, count: int) -> list[str]:
        """The end of its log."""
        return self.log.read_text(errors="replace").splitlines()[-count:]


def free_udp_ports(count: int) -> list[int]:
    """Unused ports of loopback, outside the range from which the system assigns ports.

    A daemon binds its port some time after this choice. Until then the system could assign it to another process.
    """
    ports: list[int] = []
    rng = SystemRandom()
    with ExitStack() as stack:
        while len(ports) < count:
            sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            with suppress(OSError):
                sock.bind(("127.0.0.1", rng.randrange(*_UNASSIGNED)))
                ports.append(sock.getsockname()[1])
    return ports
