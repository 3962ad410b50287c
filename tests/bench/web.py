"""What ``uavlinkd web`` costs a daemon with linked peers, and itself: ``python -m tests.bench.web``. Takes Linux."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from statistics import mean, stdev
from typing import Final

from tests.bench.contenders import LINK_PORT, until
from tests.bench.daemons import configuration, daemon_command, peer, peers_up, rules
from tests.bench.frames import load_frames
from tests.bench.measure import resident_bytes
from tests.bench.swarm import Member, Swarm
from uavlinkd.config import keys
from uavlinkd.lab.evaluation.records import cpu_seconds
from uavlinkd.ops.control import ask
from uavlinkd.web.watch import SAMPLES

PEERS, FRAMES_EACH_PER_S = 200, 1.0
BROWSERS: Final = (0, 1, 20)
PAGE_PORT: Final = 8797
LINKED_S: Final = 60.0
SETTLE_S, SLICE_S = 1.0, 4.0
ASKED: Final = 15
READ_BYTES: Final = 65536
QUICK_S: Final = 0.05
_MANY_SAMPLES: Final = (
    f"import sys; from uavlinkd.web import watch; watch.SAMPLE_S = {QUICK_S};"
    " from uavlinkd.cli import main; sys.exit(main())"
)
"""The page, which takes the samples of ten minutes in a few seconds."""


class Hub:
    """A daemon with linked peers, each of which sends."""

    def __init__(self, folder: Path, peers: int, running: ExitStack) -> None:
        private, own = [keys.generate_private_key() for _ in range(peers)], keys.generate_private_key()
        keys.write_secret_file(folder / "hub.key", own + "\n")
        sections = [
            peer(f"drone{system}", keys.public_key_text(key), rules("vehicle", system))
            for system, key in enumerate(private, 1)
        ]
        text = configuration("hub", peers=sections, endpoint="udpout:127.0.0.1:14999")
        (folder / "hub.toml").write_text(text.replace('"0.0.0.0:', '"127.0.0.1:'))
        self.control_socket = folder / "hub.sock"
        self.pid = running.enter_context(process(daemon_command(folder / "hub.toml"), folder / "log")).pid
        until(lambda: peers_up(self.control_socket) >= 0, "the daemon answers")
        public = b64decode(keys.public_key_text(own))
        members = [
            Member(b64decode(key), system, ("127.0.0.1", LINK_PORT), public) for system, key in enumerate(private, 1)
        ]
        self._swarm, self._rate = Swarm(members, load_frames().frames), FRAMES_EACH_PER_S * peers
        missing = self._swarm.link(LINKED_S)
        if missing:
            sys.exit(f"{missing} of {peers} are not linked")

    def fly(self, seconds: float) -> None:
        """Send for so long."""
        self._swarm.send_evenly(self._rate, seconds)


@contextmanager
def process(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("ab") as file, subprocess.Popen(command, stdout=file, stderr=file) as started:
        try:
            yield started
        finally:
            started.kill()  # also one that is stopped


@contextmanager
def browsers(count: int) -> Iterator[None]:
    """So many that read the events."""
    with ExitStack() as stack:
        for _ in range(count):
            sock = stack.enter_context(socket.create_connection(("127.0.0.1", PAGE_PORT)))
            sock.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            thread = threading.Thread(target=_read, args=(sock,))
            thread.start()
            stack.callback(thread.join)
            stack.callback(sock.shutdown, socket.SHUT_RDWR)
        yield


def _read(sock: socket.socket) -> None:
    with suppress(OSError):
        while sock.recv(READ_BYTES):
            pass


@contextmanager
def page(hub: Hub, folder: Path, code: str = "") -> Iterator[int]:
    """The process of the page."""
    how = ["-c", code] if code else ["-m", "uavlinkd"]
    options = ["web", "--socket", str(hub.control_socket), "--listen", f"127.0.0.1:{PAGE_PORT}"]
    with process([sys.executable, *how, *options], folder / "log") as started:
        until(_is_served, "the page listens")
        yield started.pid


def _is_served() -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", PAGE_PORT)):
        return True
    return False


def shares(hub: Hub, page_pid: int, slices: int) -> tuple[float, float, float]:
    """Of a core: what the daemon uses more because of the page, the error of that, and what the page uses.

    The page is stopped and continued in turn, so that a slow change of the machine counts on both sides.
    """
    more, own = [], []
    for _ in range(slices):
        used = []
        for number in (signal.SIGSTOP, signal.SIGCONT):
            os.kill(page_pid, number)
            hub.fly(SETTLE_S)
            began, before = time.monotonic(), [cpu_seconds(pid) for pid in (hub.pid, page_pid)]
            hub.fly(SLICE_S)
            after = [cpu_seconds(pid) for pid in (hub.pid, page_pid)]
            used.append([(b - a) / (time.monotonic() - began) for a, b in zip(before, after, strict=True)])
        (without, _), (with_page, pages) = used
        more.append(with_page - without)
        own.append(pages)
    return mean(more), stdev(more) / len(more) ** 0.5, mean(own)


def answers(hub: Hub, slices: int) -> float:
    """Seconds of the daemon's CPU time for an overview, by asking often."""
    costs = []
    for _ in range(slices):
        used = []
        for count in (0, ASKED):
            before = cpu_seconds(hub.pid)
            for _ in range(ASKED):
                if count:
                    ask(hub.control_socket, "overview")
                hub.fly(0.2)
            used.append(cpu_seconds(hub.pid) - before)
        costs.append((used[1] - used[0]) / ASKED)
    return mean(costs)


def cpu(hub: Hub, folder: Path, slices: int) -> None:
    print(f"an overview takes {answers(hub, slices) * 1e3:.2f} ms of the daemon's CPU time", flush=True)
    with page(hub, folder) as pid:
        for count in BROWSERS:
            with browsers(count):
                more, error, own = shares(hub, pid, slices)
                print(f"{count:2} browsers: daemon {more:+.2%} ± {error:.2%}, page {own:.2%} of a core", flush=True)


def memory(hub: Hub, folder: Path) -> None:
    with page(hub, folder, _MANY_SAMPLES) as pid:
        started = resident_bytes(pid)
        hub.fly(SAMPLES * 4 * QUICK_S)
        for count in BROWSERS:
            with browsers(count):
                hub.fly(6.0)
                text = f"{resident_bytes(pid) / 1e6:.1f} MB (at its start {started / 1e6:.1f} MB)"
                print(f"{count:2} browsers, samples of ten minutes: page {text}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", choices=("cpu", "memory"), default=("cpu", "memory"))
    parser.add_argument("--peers", type=int, default=PEERS)
    parser.add_argument("--slices", type=int, default=6, help="with and without the page, in turn")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="uavbench-") as name, ExitStack() as running:
        folder = Path(name)
        hub = Hub(folder, options.peers, running)
        if "cpu" in options.what:
            cpu(hub, folder, options.slices)
        if "memory" in options.what:
            memory(hub, folder)


if __name__ == "__main__":
    main()
