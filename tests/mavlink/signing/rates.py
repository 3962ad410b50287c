"""``python -m tests.mavlink.signing.rates``: processor time of a frame at each end, with and without signatures.

Two daemons as processes on loopback. Frames go from a client of the one to a client of the other at fixed rates. With
signatures, both clients are autopilots with a key. The runs alternate, and the medians are printed.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from statistics import median
from time import monotonic, sleep
from typing import Final

from tests.bench.daemons import configuration, daemon_command, peer, peers_up, rules
from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.wire import KEY, keyed
from tests.samples import attitude, frames_of
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.signing.signature import Signer
from uavlinkd.ops.control import ask

SIDES: Final = ("left", "right")
RATES: Final = (100, 1_000, 10_000)
SECONDS: Final = 4.0
PATIENCE_S: Final = 30.0


def cpu_s(process: subprocess.Popen[bytes]) -> float:
    """The processor time of a process so far."""
    return int(Path(f"/proc/{process.pid}/schedstat").read_text().split()[0]) / 1e9


def is_proven(folder: Path, side: str) -> bool:
    """Whether the autopilot at a daemon's endpoint has answered."""
    signing = ask(folder / f"{side}.sock", "status", timeout_s=2.0)["endpoints"]["client"]["signing"]
    return signing is None or bool(signing["is_verified"])


class Client:
    """A local client of one daemon, with a key or without."""

    def __init__(self, port: int, sockets: ExitStack) -> None:
        self.sock = sockets.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8_000_000)
        self.sock.connect(("127.0.0.1", port))
        self.sock.setblocking(False)
        self.autopilot = keyed(Autopilot())

    def received(self) -> Iterator[bytes]:
        """The datagrams that came."""
        with suppress(BlockingIOError):
            while True:
                yield self.sock.recv(2048)

    def answer(self) -> None:
        """One HEARTBEAT, and the answers to what came."""
        self.sock.send(self.autopilot.heartbeat())
        sleep(0.05)
        for data in self.received():
            for raw in self.autopilot.receive(data):
                self.sock.send(raw)

    def frames(self, count: int, *, signs: bool) -> list[bytes]:
        """Frames that differ, with timestamps that grow."""
        plain = [attitude(number + 1).raw for number in range(count)]
        if not signs:
            return plain
        signing, signer = self.autopilot._codec.signing, Signer(KEY)
        first = signing.timestamp + 1
        signing.timestamp += count
        return [signer.sign(raw, 3, first + number) for number, raw in enumerate(plain)]


def write_files(folder: Path, ports: dict[str, int], listens: dict[str, int], *, signs: bool) -> None:
    """The configurations of the daemons ``left`` and ``right``, and their keys."""
    private = {side: keys.generate_private_key() for side in SIDES}
    keys.write_secret_file(folder / "autopilot.key", keys.encode_key(KEY.reveal()) + "\n")
    line = '"\nsigning_key_file = "autopilot.key' if signs else ""
    for side, other, role, system in (("left", "right", "operator", 255), ("right", "left", "vehicle", 1)):
        keys.write_secret_file(folder / f"{side}.key", private[side] + "\n")
        addresses = [f"127.0.0.1:{listens[other]}"] if side == "left" else []
        public = keys.public_key_text(private[other])
        text = configuration(
            side,
            peers=[peer(other, public, rules(role, system), addresses)],
            endpoint=f"udpin:127.0.0.1:{ports[side]}{line}",
            ports=(listens[side],),
        )
        (folder / f"{side}.toml").write_text(text.replace("0.0.0.0", "127.0.0.1"))


def run(rate: int, *, signs: bool) -> tuple[float, float, float]:
    """Microseconds of a frame at the sending and the receiving daemon, and the share of frames that arrived."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        numbers = free_ports(4)
        ports, listens = (dict(zip(SIDES, pair, strict=True)) for pair in (numbers[:2], numbers[2:]))
        write_files(folder, ports, listens, signs=signs)
        daemons = {}
        for side in SIDES:
            log = stack.enter_context((folder / f"{side}.log").open("wb"))
            daemons[side] = subprocess.Popen(daemon_command(folder / f"{side}.toml"), cwd=folder, stderr=log)
            stack.callback(daemons[side].wait)
            stack.callback(daemons[side].kill)
        clients = {side: Client(ports[side], stack) for side in SIDES}
        end = monotonic() + PATIENCE_S
        while any(peers_up(folder / f"{side}.sock") != 1 or not is_proven(folder, side) for side in SIDES):
            if monotonic() > end:
                raise RuntimeError((folder / "left.log").read_text() + (folder / "right.log").read_text())
            for side in SIDES:
                with suppress(ConnectionRefusedError):
                    clients[side].answer()
        frames = clients["left"].frames(round(rate * SECONDS), signs=signs)
        clients["right"].answer()
        before = {side: cpu_s(daemons[side]) for side in SIDES}
        arrived, begin = 0, monotonic()
        for number, raw in enumerate(frames):
            while (wait := begin + number / rate - monotonic()) > 0:
                sleep(wait)
            clients["left"].sock.send(raw)
            if number % 50 == 0:
                arrived += len(frames_of(clients["right"].received()))
        sleep(0.5)
        arrived += len(frames_of(clients["right"].received()))
        costs = [(cpu_s(daemons[side]) - before[side]) / len(frames) * 1e6 for side in SIDES]
        return costs[0], costs[1], arrived / len(frames)


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.signing.rates", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    print("| frames/s | signs | sending, us | receiving, us | arrived |\n|---|---|---|---|---|")
    for rate in RATES:
        results: dict[bool, list[tuple[float, float, float]]] = {False: [], True: []}
        for number in range(2 * rounds):
            signs = number % 4 in (1, 2)
            results[signs].append(run(rate, signs=signs))
        for signs, measured in results.items():
            sending, receiving, arrived = (median(column) for column in zip(*measured, strict=True))
            print(f"| {rate:,} | {signs} | {sending:.1f} | {receiving:.1f} | {arrived:.3f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
