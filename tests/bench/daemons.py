"""uavlinkd in its modes: a vehicle's daemon on the left, its ground station's on the right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable, Host
from tests.bench.contenders import INTO_PORT, LINK_PORT, LOCAL_SINK, Contender, Running, until
from tests.bench.frames import SYSTEM
from uavlinkd.config import keys
from uavlinkd.ops.control import ControlError, ask


class Uavlinkd(Contender):
    """Two daemons that are linked, each with the role of the other in its file, as in flight.

    With two ``paths``, the right side listens at two ports.
    """

    def __init__(self, name: str, *, paths: int = 1, **link: str) -> None:
        super().__init__(name)
        self._paths = paths
        self._link = link

    def start(self, cable: Cable, folder: Path) -> Running:
        private = {side: keys.generate_private_key() for side in ("left", "right")}
        for side, text in private.items():
            keys.write_secret_file(folder / f"{side}.key", text + "\n")
        public = {side: keys.public_key_text(text) for side, text in private.items()}
        link = "".join(f"{key} = {value}\n" for key, value in self._link.items())
        addresses = [f"{cable.right.address}:{port}" for port in self._ports]
        left = configuration(
            "left",
            peers=[peer("right", public["right"], rules("operator", 255), addresses)],
            endpoint=f"udpin:127.0.0.1:{INTO_PORT}",
            link=link,
        )
        right = configuration(
            "right",
            peers=[peer("left", public["left"], rules("vehicle", SYSTEM))],
            endpoint=f"udpout:{LOCAL_SINK}",
            link=link,
            ports=self._ports,
        )
        (folder / "left.toml").write_text(left)
        (folder / "right.toml").write_text(right)
        processes = {
            host: start_daemon(host, folder / f"{side}.toml")
            for host, side in ((cable.right, "right"), (cable.left, "left"))
        }
        until(lambda: all(peers_up(folder / f"{side}.sock") == 1 for side in private), "the daemons are linked")
        return Running([processes[cable.left]], [processes[cable.right]])

    @property
    def _ports(self) -> range:
        return range(LINK_PORT, LINK_PORT + self._paths)


def rules(role: str, system: int) -> dict[str, object]:
    """Role and systems of a peer."""
    return {"role": role, "system_ids": [system]}


def peer(name: str, public: str, rules: Mapping[str, object], addresses: Sequence[str] = ()) -> str:
    said = "".join(f"{key} = {json.dumps(value)}\n" for key, value in rules.items())
    said += f"addresses = {json.dumps(addresses)}\n" if addresses else ""
    return f'\n[[peer]]\nname = "{name}"\npublic_key = "{public}"\n{said}'


def configuration(
    name: str, *, peers: Sequence[str], endpoint: str, link: str = "", ports: Iterable[int] = (LINK_PORT,)
) -> str:
    """A daemon's file; its key and control socket are beside it, by its name."""
    listen = json.dumps([f"0.0.0.0:{port}" for port in ports])
    return (
        f'name = "{name}"\nprivate_key_file = "{name}.key"\nlisten = {listen}\n'
        f'control_socket = "{name}.sock"\n\n[link]\n{link}\n'
        f'[[endpoint]]\nname = "client"\nurl = "{endpoint}"\n{"".join(peers)}'
    )


def daemon_command(config: Path) -> list[str]:
    return [sys.executable, "-m", "uavlinkd", "run", "--config", str(config)]


def start_daemon(host: Host, config: Path) -> subprocess.Popen[bytes]:
    """Start a daemon on a host; its log is beside its file."""
    return host.start(daemon_command(config), folder=config.parent, log=config.with_suffix(".log"))


def peers_up(control_socket: Path) -> int:
    """How many peers a daemon says are up; -1 where it does not answer."""
    if not control_socket.exists() or not os.access(control_socket, os.W_OK):
        return -1
    with suppress(ControlError, OSError, LookupError):
        return sum(peer["state"] == "up" for peer in ask(control_socket, "status", timeout_s=2.0)["peers"].values())
    return -1


DAEMONS: Final = (
    Uavlinkd("uavlinkd"),  # authenticated
    Uavlinkd("uavlinkd-confidential", confidential="true"),  # encrypted too
    Uavlinkd("uavlinkd-coalesced", coalesce_s="0.002"),  # authenticated, coalesce_s = 0.002
    Uavlinkd("uavlinkd-paths", paths=2),  # authenticated, two paths: stream along one of them
    Uavlinkd("uavlinkd-copies", paths=2, redundancy='"all"'),  # authenticated, two paths: every frame along both
)
