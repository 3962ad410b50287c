"""Two real daemons, each in its own process, with the clients and the relay of a measurement.

Only the initiator knows the other's address. Between them is a relay, which is closed at first, or nothing. Frames
enter at the initiator's endpoint and leave at the responder's.
"""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from fastcrc.crc16 import mcrf4xx

from uavlinkd.config.keys import generate_private_key, generate_psk, public_key_text, write_secret_file
from uavlinkd.core.suites import Suite
from uavlinkd.lab.child_processes import end_with_parent, private_folder
from uavlinkd.lab.evaluation.loop import Loop, Relay, Sink
from uavlinkd.lab.evaluation.machine import cpu_seconds
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink import dialect
from uavlinkd.ops.control import ControlError, ask

START_S = 120.0
"""How long a daemon may take to start: about 0.5 s, and much more on a busy or small machine."""
_LOOK_S = 0.01


class PairError(Exception):
    """The daemons failed. The message is for the operator."""


@dataclass(frozen=True, slots=True)
class LinkChoice:
    """The link settings of a pair."""

    suite: Suite
    mac_key_bits: int = 256
    confidential: bool = False
    rekey_after_s: float = 120.0


class DaemonProcess:
    """The folder, configuration and process of a daemon."""

    def __init__(self, name: str, folder: Path, port: int) -> None:
        self.name = name
        self.folder = folder
        self.port = port
        folder.mkdir()
        private = generate_private_key()
        write_secret_file(folder / "daemon.key", private)
        self.public_key = public_key_text(private)
        self._log = folder / "daemon.log"
        self._process: subprocess.Popen[bytes] | None = None

    def configure(self, choice: LinkChoice, endpoint: str, peer: DaemonProcess, psk: str, address: str) -> None:
        """Write the configuration; ``address`` is the peer's, or empty."""
        write_secret_file(self.folder / "pair.psk", psk)
        (self.folder / "daemon.toml").write_text(
            f"""\
name = "{self.name}"
private_key_file = "daemon.key"
listen = ["127.0.0.1:{self.port}"]
control_socket = "control.sock"

[link]
suites = ["{choice.suite.name}"]
mac_key_bits = {choice.mac_key_bits}
confidential = {str(choice.confidential).lower()}
rekey_after_s = {choice.rekey_after_s}

[[endpoint]]
name = "client"
url = "{endpoint}"

[[peer]]
name = "{peer.name}"
public_key = "{peer.public_key}"
addresses = [{f'"{address}"' if address else ""}]
psk_file = "pair.psk"
role = "all"
system_ids = "all"
""",
            encoding="utf-8",
        )

    def start(self) -> None:
        """Start the process."""
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603  constant command
                end_with_parent(
                    sys.executable, "-m", "uavlinkd", "run", "--config", str(self.folder / "daemon.toml")
                ),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def is_ready(self) -> bool:
        """Whether it answers a status request.

        Raises:
            PairError: the process has ended.
        """
        assert self._process is not None
        if self._process.poll() is not None:
            lines = " / ".join(self._log.read_text(errors="replace").splitlines()[-3:])
            raise PairError(f"{self.name} ended with status {self._process.returncode}: {lines}")
        try:
            ask(self.folder / "control.sock", "status")
        except ControlError:
            return False
        return True

    def cpu_s(self) -> float:
        """Processor time so far."""
        assert self._process is not None
        return cpu_seconds(self._process.pid)

    def drops(self) -> str:
        """Its counters of dropped datagrams, to explain a failure."""
        try:
            status = ask(self.folder / "control.sock", "status")
        except ControlError as error:
            return str(error)
        counts = dict(status["drops"])
        for peer in status["peers"].values():
            counts |= peer["drops"]
        return f"{self.name} dropped " + (", ".join(f"{n} {why}" for why, n in counts.items()) or "nothing")

    def kill(self) -> None:
        """Kill the process: it has no state to save, and a close message would be traffic."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


class Pair:
    """An initiator and a responder. Entering the context starts both.

    Then the responder is ready, and the initiator has sent an initiation to the closed relay or, without a relay, is
    about to link.
    """

    def __init__(self, choice: LinkChoice, *, with_relay: bool) -> None:
        self.loop = Loop()
        self._stack = ExitStack()
        self._stack.callback(self.loop.close)
        folder = self._stack.enter_context(private_folder("uavlinkd-"))
        ports = free_ports(3)
        self.initiator = DaemonProcess("initiator", folder / "a", ports[0])
        self.responder = DaemonProcess("responder", folder / "b", ports[1])
        self.sink = Sink(self.loop)
        self._stack.callback(self.sink.close)
        self.relay: Relay | None = None
        to = ("127.0.0.1", ports[1])
        if with_relay:
            self.relay = Relay(self.loop, to)
            self._stack.callback(self.relay.close)
            to = self.relay.address
        self._into = ("127.0.0.1", ports[2])
        self._client = self._stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        psk = generate_psk()
        self.initiator.configure(choice, f"udpin:127.0.0.1:{ports[2]}", self.responder, psk, f"{to[0]}:{to[1]}")
        self.responder.configure(choice, f"udpout:127.0.0.1:{self.sink.port}", self.initiator, psk, "")
        self._number = 0

    def send_frame(self) -> tuple[bytes, float]:
        """Send a new frame to the initiator's endpoint. Return the frame and the time."""
        self._number += 1
        frame = numbered_frame(self._number)
        now = time.monotonic()
        self._client.sendto(frame, self._into)
        return frame, now

    def cpu_s(self) -> tuple[float, float]:
        """Processor time so far, of the initiator and of the responder."""
        return self.initiator.cpu_s(), self.responder.cpu_s()

    def wait_until_linked(self, limit_s: float = START_S) -> None:
        """Send frames until one is delivered.

        Raises:
            PairError: no frame was delivered in time.
        """
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            frame, _ = self.send_frame()
            if self.loop.until(lambda: frame in self.sink.arrived, 0.1):  # noqa: B023  called in this iteration only
                return
        raise PairError(f"no link within {limit_s:g} s: {self.responder.drops()}")

    def __enter__(self) -> Self:
        try:
            for daemon in (self.responder, self.initiator):
                daemon.start()
                self._stack.callback(daemon.kill)
            for daemon in (self.responder, self.initiator):
                self._until_ready(daemon)
        except BaseException:
            self._stack.close()
            raise
        return self

    def _until_ready(self, daemon: DaemonProcess) -> None:
        until = time.monotonic() + START_S
        while not daemon.is_ready():
            if time.monotonic() >= until:
                raise PairError(f"{daemon.name} did not start within {START_S:g} s")
            self.loop.rest(_LOOK_S)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


def numbered_frame(number: int) -> bytes:
    """An ATTITUDE of 40 bytes, the most frequent frame of a flying drone; each of a link is unique."""
    payload = struct.pack("<I6f", number, *_ATTITUDE)
    inner = struct.pack("<BBBBBBHB", len(payload), 0, 0, number % 256, 1, 1, _ATTITUDE_ID, 0) + payload
    facts = dialect.facts(_ATTITUDE_ID)
    assert facts is not None, "the dialect has ATTITUDE"
    return b"\xfd" + inner + struct.pack("<H", mcrf4xx(inner + bytes((facts.crc_extra,))))


_ATTITUDE_ID = 30
_ATTITUDE = (0.1, -0.05, 1.5, 0.01, 0.02, -0.01)
"""Roll, pitch and yaw in radians, and their rates."""
