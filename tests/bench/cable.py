"""Two hosts on this machine, with a cable (veth) between them, and the processes that run there."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from tests.namespaces import Namespace, connect, remove_leftovers
from uavlinkd.lab.child_processes import end_with_parent

ETHERNET_BYTES: Final = 14
"""The Ethernet header, which veth counts with each packet, and which is not part of IP's bytes."""
END_S: Final = 5.0
"""A process that does not end in this time is killed."""
_DEVICE: Final = "cable"


@dataclass(frozen=True, slots=True)
class Counted:
    """Traffic on the cable in both directions: packets, and their bytes from the IP header on."""

    packets: int
    bytes: int

    def since(self, before: Counted) -> Counted:
        return Counted(self.packets - before.packets, self.bytes - before.bytes)


class Host(Namespace):
    """One namespace, and the processes that run in it. ``address``: its own, on the cable."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
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
                end_with_parent(*self.launcher, *command),
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

    def end(self, *processes: subprocess.Popen[bytes]) -> None:
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in processes:
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
        self._processes = [process for process in self._processes if process not in processes]

    def end_all_but(self, kept: Collection[subprocess.Popen[bytes]] = ()) -> None:
        """End all processes that were started here but these."""
        self.end(*(process for process in self._processes if process not in kept))

    def close(self) -> None:
        self.end_all_but()
        super().close()


class Cable:
    """Two hosts and what is between them, as a context::

    with Cable() as cable:
        cable.left.start(["uavlinkd", "run", ...])
    """

    def __init__(self) -> None:
        self.left = Host("10.213.0.1")
        self.right = Host("10.213.0.2")
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        remove_leftovers()
        with ExitStack() as stack:
            for host in (self.left, self.right):
                stack.callback(host.close)
                host.open()
            connect(self.right, _DEVICE, self.left, _DEVICE)
            for host in (self.left, self.right):
                # The kernel splits what is sent in one call (UDP_SEGMENT) before the cable, as before a real one.
                host.ip(f"link set {_DEVICE} gso_max_segs 1", f"address add {host.address}/24 dev {_DEVICE}")
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def counted(self) -> Counted:
        shown = json.loads(self.left.run("ip", "-s", "-j", "link", "show", _DEVICE))
        ways = [shown[0]["stats64"][way] for way in ("tx", "rx")]
        packets = sum(way["packets"] for way in ways)
        return Counted(packets, sum(way["bytes"] for way in ways) - packets * ETHERNET_BYTES)
