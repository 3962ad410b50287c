"""Two hosts on this machine: network namespaces with a cable (veth) between them.

Whatever is started in them, and they themselves, are gone when the block ends, however it ends. What a run left that
was killed outright (SIGKILL) is removed by the next.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from uavlinkd.lab.child_processes import end_with_parent

ETHERNET_BYTES: Final = 14
"""The Ethernet header, which veth counts with each packet, and which is not part of IP's bytes."""
LEFT_ADDRESS: Final = "10.213.0.1"
RIGHT_ADDRESS: Final = "10.213.0.2"
END_S: Final = 5.0
"""A process that does not end in this time is killed."""
_PREFIX: Final = "uavbench"
_NAME = re.compile(_PREFIX + r"-(\d+)-\d+-(?:left|right)")
_numbers = count()


class NamespaceError(Exception):
    """The hosts cannot be made. The message is for a person."""


@dataclass(frozen=True, slots=True)
class Counted:
    """Traffic on the cable in both directions: packets, and their bytes from the IP header on."""

    packets: int
    bytes: int

    def since(self, before: Counted) -> Counted:
        """The traffic since then."""
        return Counted(self.packets - before.packets, self.bytes - before.bytes)


def why_not() -> str | None:
    """The reason why this user cannot make namespaces on this machine, or None."""
    if os.geteuid():
        return "network namespaces take root: run it as root"
    if shutil.which("ip") is None:
        return "there is no `ip`: install iproute2"
    name = f"{_PREFIX}-{os.getpid()}-{next(_numbers)}-left"
    tried = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)
    return tried.stderr.strip() if tried.returncode else None


def remove_leftovers() -> None:
    """End the processes in the namespaces of killed runs, and remove them."""
    for line in _ip("netns", "list").splitlines():
        match = _NAME.fullmatch(line.split()[0]) if line.split() else None
        if match and not Path("/proc", match[1]).exists():
            _remove(match[0])


def _remove(name: str) -> None:
    """A namespace, with its processes: also one that was starting when the run was interrupted."""
    for pid in _ip("netns", "pids", name, check=False).split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    _ip("netns", "delete", name, check=False)


class Host:
    """One namespace, and the processes that run in it."""

    def __init__(self, name: str, address: str, device: str) -> None:
        self.name = name
        self.address = address
        """Its own, on the cable."""
        self.device = device
        """Its end of the cable."""
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(
        self,
        command: Sequence[str],
        *,
        folder: Path | None = None,
        log: Path | None = None,
        environ: Mapping[str, str] | None = None,
        pipes: bool = False,
    ) -> subprocess.Popen[bytes]:
        """Start a command here, in a session of its own. ``pipes``: its standard input and output are pipes."""
        out: IO[bytes] | int = log.open("ab") if log is not None else subprocess.DEVNULL
        try:
            process = subprocess.Popen(
                end_with_parent("ip", "netns", "exec", self.name, *command),
                cwd=folder,
                env={**os.environ, **(environ or {})},
                stdin=subprocess.PIPE if pipes else subprocess.DEVNULL,
                stdout=subprocess.PIPE if pipes else out,
                stderr=out,
                start_new_session=True,
            )
        finally:
            if not isinstance(out, int):
                out.close()
        self._processes.append(process)
        return process

    def run(self, *command: str) -> str:
        """Run a command here to its end; returns its output.

        Raises:
            NamespaceError: it failed.
        """
        return _run("ip", "netns", "exec", self.name, *command)

    def end(self, *processes: subprocess.Popen[bytes]) -> None:
        """End these processes; by default all that were started here."""
        ended = processes or tuple(self._processes)
        for process in ended:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in ended:
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with suppress(OSError):  # what it did not read any more
                        stream.close()
        self._processes = [process for process in self._processes if process not in ended]

    def end_all_but(self, kept: Collection[subprocess.Popen[bytes]]) -> None:
        """End all processes that were started here but these."""
        gone = [process for process in self._processes if process not in kept]
        if gone:
            self.end(*gone)


class CableKind(StrEnum):
    """How the cable handles datagrams that are sent in one call (UDP_SEGMENT)."""

    PLAIN = "plain"
    """The kernel splits them before the cable, as before a real one; they arrive one by one."""
    CARD = "card"
    """The same, and they are merged on receipt on request (UDP_GRO), as by drivers of network cards."""
    WHOLE = "whole"
    """They cross in one piece, as between virtual machines on one host; their bytes are then counted too low."""


class Cable:
    """Two hosts and what is between them::

    with Cable() as cable:
        cable.left.start(["uavlinkd", "run", ...])
    """

    def __init__(self, kind: CableKind = CableKind.PLAIN) -> None:
        self.kind = kind
        name = f"{_PREFIX}-{os.getpid()}-{next(_numbers)}"
        self.left = Host(f"{name}-left", LEFT_ADDRESS, "cable")
        self.right = Host(f"{name}-right", RIGHT_ADDRESS, "cable")

    def __enter__(self) -> Self:
        remove_leftovers()
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self) -> None:
        for host in (self.left, self.right):
            _ip("netns", "add", host.name)
            _ip("-n", host.name, "link", "set", "lo", "up")
        peer = ("type", "veth", "peer", "name", self.right.device, "netns", self.right.name)
        _ip("-n", self.left.name, "link", "add", self.left.device, *peer)
        for host in (self.left, self.right):
            if self.kind is not CableKind.WHOLE:
                _ip("-n", host.name, "link", "set", host.device, "gso_max_segs", "1")
            if self.kind is CableKind.CARD:
                host.run(sys.executable, str(Path(__file__).with_name("offload.py")), host.device)
            _ip("-n", host.name, "address", "add", f"{host.address}/24", "dev", host.device)
            _ip("-n", host.name, "link", "set", host.device, "up")

    def close(self) -> None:
        """End the processes there, and remove both."""
        for host in (self.left, self.right):
            host.end()
        for host in (self.left, self.right):
            _remove(host.name)

    def counted(self) -> Counted:
        """The traffic so far."""
        shown = json.loads(_ip("-n", self.left.name, "-s", "-j", "link", "show", self.left.device))
        ways = [shown[0]["stats64"][way] for way in ("tx", "rx")]
        packets = sum(way["packets"] for way in ways)
        # If packets are merged on receipt, veth counts them there, without their Ethernet headers.
        headers = 0 if self.kind is CableKind.CARD else packets * ETHERNET_BYTES
        return Counted(packets, sum(way["bytes"] for way in ways) - headers)


def _ip(*arguments: str, check: bool = True) -> str:
    return _run("ip", *arguments, check=check)


def _run(*command: str, check: bool = True) -> str:
    ended = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if check and ended.returncode:
        raise NamespaceError(f"`{' '.join(command)}` failed: {(ended.stderr or ended.stdout).strip()}")
    return ended.stdout
