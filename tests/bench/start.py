"""The start of a daemon: processor time until a frame passes, and memory then: ``python -m tests.bench.start``.

A second daemon, the peer, runs all the time.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from tests.bench.daemons import configuration, peer, rules
from tests.bench.measure import resident_bytes
from tests.limited_cpu import limited_cpu
from tests.processes import frames
from tests.waiting import PATIENCE_S
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_ports

SEND_EVERY_S: Final = 0.01
LIBRARIES: Final = "import asyncio, cryptography.hazmat.primitives.asymmetric.x25519"
"""What every daemon of this kind imports. Its processor time is the unit of a start in tests."""


Launcher = tuple[str, ...]


class Start(NamedTuple):
    """``cpu_s``: processor time from exec until a frame of its client left the peer, which took ``time_s``.

    ``rss``: resident bytes then.
    """

    cpu_s: float
    time_s: float
    rss: int


@contextmanager
def started(python: str = sys.executable, launchers: Sequence[Launcher] = ((), ())) -> Iterator[Pair]:
    """A pair of daemons, of which the peer runs. Both are of the package that ``python`` imports.

    ``launchers``: what is written before the command of each.
    """
    with tempfile.TemporaryDirectory(prefix="uavstart-") as name, socket.socket(type=socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.settimeout(SEND_EVERY_S)
        pair = Pair(Path(name), client, python, launchers)
        try:
            yield pair
        finally:
            pair.end()


class Pair:
    """The daemon that is measured, and its peer. The only client is at both ends."""

    def __init__(self, folder: Path, client: socket.socket, python: str, launchers: Sequence[Launcher]) -> None:
        self._folder, self._client = folder, client
        self._launchers = dict(zip(("near", "far"), launchers, strict=True))
        self._command = [python, "-m", "uavlinkd", "run", "--config"]
        # An environment that forbids bytecode would make this measure the compiler.
        self._environ = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        link, self._endpoint = free_ports(2)
        public = {}
        for side in ("near", "far"):
            private = keys.generate_private_key()
            keys.write_secret_file(folder / f"{side}.key", private)
            public[side] = keys.public_key_text(private)
        near = configuration(
            "near",
            peers=[peer("far", public["far"], rules("operator", 255), [f"127.0.0.1:{link}"])],
            endpoint=f"udpin:127.0.0.1:{self._endpoint}",
            ports=(),
        )
        far = configuration(
            "far",
            peers=[peer("near", public["near"], rules("vehicle", 1))],
            endpoint=f"udpout:127.0.0.1:{client.getsockname()[1]}",
            ports=[link],
        )
        for side, text in (("near", near), ("far", far)):
            (folder / f"{side}.toml").write_text(text)
        self._far = self._run("far")
        self._starts = 0
        """Each sends another frame: late ones of the daemon before are not its own."""

    def _run(self, side: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{side}.log").open("ab") as log:
            return subprocess.Popen(
                [*self._launchers[side], *self._command, str(self._folder / f"{side}.toml")],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._environ,
            )

    def start(self) -> Start:
        """Start the daemon, send frames until one has passed, and kill the daemon: its peer notices nothing."""
        began = time.monotonic()
        near = self._run("near")
        try:
            self._until_passed(near)
            return Start(process_seconds(near.pid), time.monotonic() - began, resident_bytes(near.pid))
        finally:
            near.kill()
            near.wait()

    def _until_passed(self, near: subprocess.Popen[bytes]) -> None:
        self._starts += 1
        frame, deadline = frames.heartbeat(1, seq=self._starts % 256), time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            self._client.sendto(frame, ("127.0.0.1", self._endpoint))
            try:
                if self._client.recv(4096).endswith(frame):
                    return
            except TimeoutError:
                assert near.poll() is None, (self._folder / "near.log").read_text()
            except ConnectionRefusedError:  # ICMP: the endpoint is not open yet
                time.sleep(SEND_EVERY_S)
        raise TimeoutError("no frame passes: " + (self._folder / "near.log").read_text())

    def end(self) -> None:
        self._far.terminate()
        self._far.wait()


def process_seconds(pid: int) -> float:
    """The processor time of a process, of its threads that ended and of its children that it waited for."""
    clock = ~pid << 3 | 2  # as clock_getcpuclockid(3)
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    children = (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(clock) + children


def libraries_seconds(python: str = sys.executable) -> float:
    """The processor time of an interpreter that only imports :data:`LIBRARIES`."""
    process = subprocess.Popen([python, "-c", LIBRARIES])
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=15)
    parser.add_argument("--python", default=sys.executable, help="the interpreter of the daemons")
    parser.add_argument("--share", type=float, help="of a core, by a control group for each daemon, such as 0.12")
    options = parser.parse_args()
    with ExitStack() as stack:
        groups = [stack.enter_context(limited_cpu(options.share)).launcher for _ in range(2) if options.share]
        pair = stack.enter_context(started(options.python, groups or ((), ())))
        pair.start()  # writes the bytecode
        both = [(pair.start(), libraries_seconds(options.python)) for _ in range(options.starts)]
    starts, libraries = zip(*both, strict=True)
    cpu, unit = [start.cpu_s for start in starts], libraries
    print(f"CPU until a frame passes: {1000 * min(cpu):.0f} ms at best, median {1000 * median(cpu):.0f} ms")
    print(f"time: {min(start.time_s for start in starts):.2f} to {max(start.time_s for start in starts):.2f} s")
    print(f"the libraries alone: {1000 * min(unit):.0f} ms at best, median {1000 * median(unit):.0f} ms")
    print(f"ratio: {min(cpu) / min(unit):.2f} at best, of medians {median(cpu) / median(unit):.2f}")
    print(f"resident: {max(start.rss for start in starts) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
