"""A vehicle on one host and a tablet with the real wireguard-go on another one, with a cable between them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from types import TracebackType
from typing import Any, Final, Self

from tests.bench.cable import Cable, Host
from tests.namespaces import need_namespaces
from tests.needs import need
from tests.waiting import PATIENCE_S
from uavlinkd.config import keys
from uavlinkd.ops.control import ControlError, ask

REPOSITORY: Final = Path(__file__).parents[2]
AUTOPILOT_PORT: Final = 14600
"""Where the vehicle's daemon receives its autopilot."""
PORT: Final = 51820
"""Where the daemon receives stations."""
_numbers = count()
_BLOCKS: Final = {" ": (0, 0), "▀": (255, 0), "▄": (0, 255), "█": (255, 255)}
"""Brightness of the upper and lower half of a character, on a dark terminal."""
_DOT: Final = 4


def need_wireguard() -> None:
    """Skip a test without wireguard-go, its tools and network namespaces."""
    need_namespaces("wg", "wg-quick", "wireguard-go", "nft")
    need(Path("/dev/net/tun").exists(), "/dev/net/tun")


def until(condition: Callable[[], object], what: str) -> None:
    """Wait for a condition."""
    deadline = monotonic() + PATIENCE_S
    while not condition():
        assert monotonic() < deadline, f"it did not happen: {what}"
        sleep(0.005)


def picture(printed: str) -> bytes:
    """The QR code in the output of a command, as a terminal shows it: a picture in the PGM format."""
    lines = [line for line in printed.splitlines() if line and set(line) <= set(_BLOCKS)]
    rows = [bytes(_BLOCKS[character][half] for character in line) for line in lines for half in (0, 1)]
    wide = [bytes(value for value in row for _ in range(_DOT)) for row in rows]
    header = f"P5 {len(wide[0])} {len(wide) * _DOT} 255\n".encode()
    return header + b"".join(row for row in wide for _ in range(_DOT))


class App:
    """The WireGuard app on a host: ``text`` is what it scanned or imported."""

    def __init__(self, host: Host, text: str, folder: Path) -> None:
        self.device = (
            f"wg{os.getpid() % 10**7}s{next(_numbers)}"  # its control socket is the machine's, so the name is
        )
        self.address = str(re.findall(r"^Address = ([^/\n]+)", text, re.MULTILINE)[0])
        self._host = host
        host.start(["wireguard-go", "-f", self.device], log=folder / f"{self.device}.log")
        until(lambda: self.device in host.run("ip", "-o", "link", "show"), "the interface is there")
        file = folder / f"{self.device}.conf"
        file.touch(0o600)
        file.write_text(text)
        file.write_text(host.run("wg-quick", "strip", str(file)))
        host.run("wg", "setconf", self.device, str(file))
        host.ip(f"address add {self.address}/32 dev {self.device}")

    def switch_on(self) -> float:
        """The interface goes up; when it did. What the daemon sends comes only now."""
        self._host.ip(f"link set {self.device} up mtu 1280")
        at = monotonic()
        self._host.ip(f"route add 10.66.0.1/32 dev {self.device}")
        return at


class Scene:
    """A vehicle with its daemon and a simulated autopilot; a tablet. A context."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self.cable = Cable()
        self.vehicle, self.tablet = self.cable.right, self.cable.left

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self.folder = Path(stack.enter_context(TemporaryDirectory(prefix="uavlinkd-")))
            stack.enter_context(self.cable)
            self.config = self.folder / "drone1.toml"
            keys.write_secret_file(self.folder / "drone1.key", keys.generate_private_key())
            self.config.write_text(
                'name = "drone1"\nprivate_key_file = "drone1.key"\ncontrol_socket = "drone1.sock"\n\n'
                f'[[endpoint]]\nname = "autopilot"\nurl = "udpin:127.0.0.1:{AUTOPILOT_PORT}"\nsystem_ids = [1]\n'
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            for log in sorted(self.folder.glob("*.log")):  # pytest shows this where a test fails
                print(f"--- {log.name}", log.read_text(errors="replace")[-3000:], sep="\n")
        self._stack.close()

    def add(self, name: str, *more: str) -> str:
        """What ``uavlinkd station add`` prints."""
        command = (*UAVLINKD, "station", "add", name, "--config", str(self.config), "--at", self.vehicle.address)
        return subprocess.run((*command, *more), cwd=REPOSITORY, check=True, capture_output=True, text=True).stdout

    def start_daemon(self) -> subprocess.Popen[bytes]:
        """The vehicle's daemon; it answers on its control socket."""
        command = [*UAVLINKD, "run", "--config", str(self.config)]
        process = self.vehicle.start(command, folder=REPOSITORY, log=self.folder / "drone1.log")
        until(self.is_running, "the daemon answers")
        return process

    def is_running(self) -> bool:
        """Whether the daemon answers."""
        try:
            self.status()
        except ControlError:
            return False
        return True

    def start_autopilot(self) -> subprocess.Popen[bytes]:
        """The simulated autopilot."""
        command = [*UAVLINKD, "sim", "--url", f"udpout:127.0.0.1:{AUTOPILOT_PORT}"]
        return self.vehicle.start(command, folder=REPOSITORY, log=self.folder / "sim.log")

    def status(self) -> dict[str, Any]:
        """The daemon's status."""
        return ask(self.folder / "drone1.sock", "status")

    def app(self, printed: str) -> App:
        """The app with what a command printed, on the tablet."""
        return App(self.tablet, text_in(printed), self.folder)

    def run_on_tablet(self, *command: str) -> str:
        """Run a client on the tablet to its end; what it prints on standard output."""
        ended = subprocess.run(
            (*self.tablet.launcher, *command), cwd=REPOSITORY, check=False, capture_output=True, text=True
        )
        assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
        return ended.stdout


UAVLINKD: Final = (sys.executable, "-m", "uavlinkd")


def text_in(printed: str) -> str:
    """The text for the app in what ``station add`` printed."""
    return printed[printed.index("[Interface]") : printed.index("\nSet the system id")]
