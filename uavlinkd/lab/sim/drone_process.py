"""A daemon in its own process, with its files in a folder, for the demo and the evaluation."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavlinkd.config.keys import decode_key, generate_private_key, public_key_text, write_secret_file
from uavlinkd.lab.child_processes import end_with_parent, stop_child
from uavlinkd.ops.control import ControlError, ask

STOP_S = 60.0
"""How long a daemon may take to stop after SIGTERM: much longer than needed, for busy machines."""


class DroneError(Exception):
    """A daemon failed. The message is for the operator."""


class DroneProcess:
    """The daemon of one drone. Configure it, then start it; it may be killed and restarted.

    Args:
        name: its name here and for its peers.
        folder: for its files; created here.
        port: the port for peers, on loopback.
        endpoint_port: the port for its autopilot, on loopback.
    """

    command = "run"

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
        """The private key, as an attacker has it after capturing this drone."""
        return decode_key(self._private)

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def configure(
        self,
        link: Mapping[str, object],
        peers: Sequence[Mapping[str, object]],
        networks: Sequence[Mapping[str, object]] = (),
        relays: Sequence[Mapping[str, object]] = (),
        others: Sequence[tuple[str, Mapping[str, object]]] = (),
    ) -> None:
        """Write the configuration: the ``[link]`` section, each ``[[peer]]``, ``[[network]]`` and ``[[relay]]``, and
        ``others`` with their titles.
        """
        has_interfaces = any("serial" not in network for network in networks)
        endpoint = {"name": "autopilot", "url": f"udpin:127.0.0.1:{self.endpoint_port}"}
        tables = [("[link]", link), ("[[endpoint]]", endpoint)]
        tables += [("[[network]]", network) for network in networks]
        tables += [("[[relay]]", relay) for relay in relays]
        tables += [("[[peer]]", peer) for peer in peers]
        tables += others
        self.write(tables, "0.0.0.0" if has_interfaces else "127.0.0.1")

    def write(self, sections: Sequence[tuple[str, Mapping[str, object]]], host: str = "127.0.0.1") -> None:
        """Write the configuration: the name, the key, the sockets, then these sections."""
        top = {
            "name": self.name,
            "private_key_file": "drone.key",
            "listen": [f"{host}:{self.port}"],
            "control_socket": self.socket.name,
        }
        tables = [("", top), *sections]
        lines = [f"{name}\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in t.items()) for name, t in tables]
        (self.folder / "drone.toml").write_text("\n".join(lines).lstrip(), encoding="utf-8")

    def as_peer(self, address: str, psk_file: str, **settings: object) -> dict[str, object]:
        """The ``[[peer]]`` section for this drone in another drone's configuration, with ``settings``."""
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
        write_secret_file(self.folder / file, psk)

    async def start(self) -> None:
        """Start the process. Its log is appended to the log of the process before."""
        with self.log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *end_with_parent(
                    *_interpreter(), "-m", "uavlinkd", self.command, "--config", str(self.folder / "drone.toml")
                ),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """Stop the process: first with a signal, then by killing it."""
        if self._process is not None:
            await stop_child(self._process, number, STOP_S)

    async def ask(self) -> dict[str, Any]:
        """Request the daemon's status. While it does not listen, return the last status, or an empty one.

        Raises:
            DroneError: the process has ended.
        """
        if self._process is not None and self._process.returncode is not None:
            lines = "\n".join(self.last_lines(5))
            raise DroneError(f"the daemon of {self.name} ended with status {self._process.returncode}:\n{lines}")
        with suppress(ControlError):  # not listening yet
            self.status = await asyncio.to_thread(ask, self.socket, "status")
        return self.status

    @property
    def peer_statuses(self) -> list[dict[str, Any]]:
        """The status of its peers; empty before the first answer."""
        return list(self.status.get("peers", {}).values())

    def last_lines(self, count: int) -> list[str]:
        return self.log.read_text(errors="replace").splitlines()[-count:]


def _toml(value: object) -> str:
    """A value as in TOML: JSON, but for tables."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)


def _interpreter() -> tuple[str, ...]:
    """The command of this Python interpreter, with ``-P`` unless this process imports from the current folder too.

    Without ``-P``, the daemon would import a file in the current folder that has the name of a module.
    """
    here = {""}
    with suppress(OSError):  # the current folder was deleted
        here.add(os.getcwd())
    return (sys.executable,) if sys.path[0] in here else (sys.executable, "-P")
