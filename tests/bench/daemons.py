"""uavlinkd, in the ways in which it is used: a vehicle's daemon on the left, its ground station's on the right."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from tests.bench.contenders import INTO_PORT, LINK_PORT, LOCAL_SINK, Contender, Running, needs_module, until
from tests.bench.frames import SYSTEM
from tests.bench.namespaces import Cable, Host
from tests.daemon.harness import WITHOUT_UVLOOP
from uavlinkd import keys
from uavlinkd.control import ControlError, ask


class Uavlinkd(Contender):
    """Two daemons that are linked, each with the role of the other in its file, as in flight."""

    def __init__(self, name: str, about: str, *, uvloop: bool = True, **link: str) -> None:
        super().__init__(name, about)
        self._uvloop = uvloop
        self._link = link

    def why_not(self) -> str | None:
        return needs_module("uvloop") if self._uvloop else None

    def start(self, cable: Cable, folder: Path) -> Running:
        private = {side: keys.generate_private_key() for side in ("left", "right")}
        for side, text in private.items():
            keys.write_secret_file(folder / f"{side}.key", text + "\n")
        public = {side: keys.public_key_text(text) for side, text in private.items()}
        link = "".join(f"{key} = {value}\n" for key, value in self._link.items())
        left = configuration(
            "left",
            peers=[peer("right", public["right"], "operator", [255], f"{cable.right.address}:{LINK_PORT}")],
            endpoint=f"udpin:127.0.0.1:{INTO_PORT}",
            link=link,
        )
        right = configuration(
            "right",
            peers=[peer("left", public["left"], "vehicle", [SYSTEM])],
            endpoint=f"udpout:{LOCAL_SINK}",
            link=link,
        )
        (folder / "left.toml").write_text(left)
        (folder / "right.toml").write_text(right)
        processes = {
            host: start_daemon(host, folder / f"{side}.toml", uvloop=self._uvloop)
            for host, side in ((cable.right, "right"), (cable.left, "left"))
        }
        until(lambda: all(peers_up(folder / f"{side}.sock") == 1 for side in private), "the daemons are linked")
        return Running([processes[cable.left]], [processes[cable.right]])


def peer(name: str, public: str, role: str, systems: Sequence[int], address: str = "") -> str:
    """A ``[[peer]]``."""
    called = f'addresses = ["{address}"]\n' if address else ""
    said = f'role = "{role}"\nsystem_ids = {list(systems)}\n{called}'
    return f'\n[[peer]]\nname = "{name}"\npublic_key = "{public}"\n{said}'


def configuration(name: str, *, peers: Sequence[str], endpoint: str, link: str = "") -> str:
    """A daemon's file; its key and control socket are beside it, by its name."""
    return (
        f'name = "{name}"\nprivate_key_file = "{name}.key"\nlisten = ["0.0.0.0:{LINK_PORT}"]\n'
        f'control_socket = "{name}.sock"\n\n[link]\n{link}\n'
        f'[[endpoint]]\nname = "program"\nurl = "{endpoint}"\n{"".join(peers)}'
    )


def daemon_command(config: Path, *, uvloop: bool = True) -> list[str]:
    """How a daemon is run."""
    program = ["-m", "uavlinkd"] if uvloop else ["-c", WITHOUT_UVLOOP]
    return [sys.executable, *program, "run", "--config", str(config)]


def start_daemon(
    host: Host, config: Path, *, uvloop: bool = True, environ: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a daemon on a host; its log is beside its file."""
    return host.start(
        daemon_command(config, uvloop=uvloop), folder=config.parent, log=config.with_suffix(".log"), environ=environ
    )


def peers_up(control_socket: Path) -> int:
    """How many peers a daemon says are up; -1 where it does not answer."""
    if not control_socket.exists() or not os.access(control_socket, os.W_OK):
        return -1
    with suppress(ControlError, OSError, LookupError):
        return sum(each["state"] == "up" for each in ask(control_socket, "status", timeout_s=2.0)["peers"].values())
    return -1


DAEMONS: Final = (
    Uavlinkd("uavlinkd", "authenticated"),
    Uavlinkd("uavlinkd-confidential", "encrypted too", confidential="true"),
    Uavlinkd("uavlinkd-coalesced", "authenticated, coalesce_s = 0.002", coalesce_s="0.002"),
    Uavlinkd("uavlinkd-asyncio", "authenticated, without uvloop", uvloop=False),
)
