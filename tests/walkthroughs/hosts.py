"""Hosts made of namespaces: each has a network, a ``/dev`` with a serial autopilot, and a folder of its own."""

from __future__ import annotations

import os
import pty
import shlex
import signal
import socket
import stat
import subprocess
import sys
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.compose.machine import Machine
from tests.namespaces import udp_socket_in
from tests.waiting import PATIENCE_S

HOME = "/mnt"
"""Where each host sees its own folder."""
_DEVICES = "null zero full random urandom tty"


class Network:
    """A bridge in a namespace. Hosts are connected to it with cables."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tools = folder / "tools"
        self.tools.mkdir()
        self._add_tool("sudo", 'exec "$@"')
        # No ssh runs on the hosts: a copy into the other host's folder takes its place, and a command there.
        self._add_tool(
            "scp", f'shift; for last; do :; done; exec cp -pr "$1" {shlex.quote(str(folder))}/"${{last%:}}"/'
        )
        pid = f'"$(cat {shlex.quote(str(folder))}/$host.pid)"'
        there = f'nsenter --target={pid} --mount --net sh -euc "cd {HOME}; $*"'
        self._add_tool("ssh", f'[ "$1" != -- ] || shift; host=$1; shift; exec {there}')
        self.switch = Host(self, "switch")
        self.switch.run("ip link add air type bridge && ip link set air up")

    def _add_tool(self, name: str, script: str) -> None:
        path = self.tools / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(stat.S_IRWXU)

    def connect(self, host: Host | Container, *addresses: str) -> None:
        """Lay a cable, and give the host these addresses (with prefix length) at its end."""
        self.switch.run(f"ip link add to-{host.name} type veth peer name eth0 netns {host.pid}")
        self.switch.run(f"ip link set to-{host.name} master air up")
        enter = f"nsenter --target={host.pid} --net ip"
        subprocess.run([*enter.split(), *["link", "set", "eth0", "up"]], check=True)
        for address in addresses:
            subprocess.run([*enter.split(), "address", "add", address, "dev", "eth0"], check=True)


class Host:
    """One machine: a process holds its namespaces, and they end with it."""

    def __init__(self, network: Network, name: str) -> None:
        self._network = network
        self.name = name
        self.folder = network.folder / name
        self.folder.mkdir()
        self._daemons: list[subprocess.Popen[bytes]] = []
        self.autopilot, device = pty.openpty()
        tty.setraw(self.autopilot)
        os.set_blocking(self.autopilot, False)
        setup = f"""
            mount --bind {shlex.quote(str(self.folder))} {HOME}
            mount -t tmpfs tmpfs /run
            mkdir /run/dev && mount -t tmpfs tmpfs /run/dev && cd /run/dev
            for device in {_DEVICES}; do touch $device && mount --bind /dev/$device $device; done
            mkdir pts && mount --rbind /dev/pts pts && ln -s pts/ptmx ptmx && ln -s {os.ttyname(device)} ttyACM0
            cd / && mount --move /run/dev /dev
            ip link set lo up
            echo ready
            exec sleep infinity
        """
        self._holder = subprocess.Popen(
            ["setpriv", "--pdeathsig=KILL", "unshare", "--net", "--mount", "sh", "-euc", setup],
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
        )
        assert self._holder.stdout is not None
        assert self._holder.stdout.readline() == b"ready\n"
        self._device = device
        self.pid = self._holder.pid
        (network.folder / f"{name}.pid").write_text(str(self.pid))

    def close(self) -> None:
        """End the daemons as a shutdown does, then everything else."""
        for daemon in self._daemons:
            daemon.send_signal(signal.SIGTERM)
        statuses = [daemon.wait(PATIENCE_S) for daemon in self._daemons]
        self._holder.kill()
        self._holder.wait()
        assert self._holder.stdout is not None
        self._holder.stdout.close()
        os.close(self.autopilot)
        os.close(self._device)
        assert not any(statuses), self.log

    @property
    def log(self) -> str:
        path = self._network.folder / f"{self.name}.log"
        return path.read_text() if path.exists() else ""

    def _command(self, command: str) -> list[str]:
        return ["nsenter", f"--target={self.pid}", "--net", "--mount", "sh", "-euc", f"cd {HOME}; {command}"]

    @property
    def _environ(self) -> dict[str, str]:
        tools = (self._network.tools, Path(sys.executable).parent)
        return {**os.environ, "PATH": ":".join((*map(str, tools), os.environ["PATH"])), "COLUMNS": "80"}

    def try_to(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a shell command, with any exit status."""
        return subprocess.run(
            self._command(command),
            capture_output=True,
            text=True,
            check=False,
            env=self._environ,
            stdin=subprocess.DEVNULL,
        )

    def run(self, command: str) -> str:
        """What a shell command prints, which has to succeed."""
        done = self.try_to(command)
        assert done.returncode == 0, f"{self.name}: {command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def save(self, file: str, text: str) -> None:
        (self.folder / file).write_text(text)

    def start(self, command: str) -> None:
        with (self._network.folder / f"{self.name}.log").open("ab") as log:
            self._daemons.append(
                subprocess.Popen(
                    self._command(f"exec {command}"),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=self._environ,
                )
            )

    def open_socket(self, port: int) -> socket.socket:
        return udp_socket_in(Path(f"/proc/{self.pid}/ns/net"), port=port)


class Container:
    """A machine with systemd, in place of a Raspberry Pi."""

    def __init__(self, name: str, machine: Machine, folder: Path) -> None:
        self.name = name
        self._machine = machine
        self._folder = folder
        self.pid = machine.pid
        machine.say("printf '#!/bin/sh\\nexec \"$@\"\\n' >/usr/local/bin/sudo && chmod 0755 /usr/local/bin/sudo")

    @property
    def log(self) -> str:
        return self._machine.run("journalctl --no-pager --output=cat").stdout

    def try_to(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a shell command, with any exit status."""
        return self._machine.run(f"cd /root; {command} </dev/null")

    def run(self, command: str) -> str:
        """What a shell command prints, which has to succeed."""
        return self._machine.say(f"cd /root; {command} </dev/null")

    def save(self, file: str, text: str) -> None:
        path = self._folder / "saved"
        path.write_text(text)
        self._machine.put(path, file)


def until(condition: Callable[[], bool], describe: Callable[[], str]) -> None:
    """Wait for a condition. Raises AssertionError if it does not hold in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, describe()
        time.sleep(0.1)


class Autopilot:
    """An autopilot at a host's serial port."""

    def __init__(self, host: Host) -> None:
        self._port = host.autopilot
        self.received = bytearray()

    def send(self, frame: bytes) -> None:
        """Write a frame; what the daemon does not read in time is lost."""
        with suppress(BlockingIOError):
            os.write(self._port, frame)

    def poll(self) -> bytearray:
        with suppress(BlockingIOError, OSError):
            while data := os.read(self._port, 4096):
                self.received += data
        return self.received


class GroundStation:
    """QGroundControl's place: it listens on port 14550 of a host's loopback."""

    def __init__(self, host: Host) -> None:
        self._socket = host.open_socket(14550)
        self._daemon: tuple[str, int] | None = None
        self.received = bytearray()

    def send(self, frame: bytes) -> None:
        """Answer to where frames came from; before any came, do nothing."""
        if self._daemon is not None:
            self._socket.sendto(frame, self._daemon)

    def poll(self) -> bytearray:
        with suppress(BlockingIOError, ConnectionError):
            while True:
                data, self._daemon = self._socket.recvfrom(4096)
                self.received += data
        return self.received

    def close(self) -> None:
        self._socket.close()
