"""Network namespaces: hosts and routers on this machine, and the cables between them."""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from tests.needs import need

_PREFIX: Final = "uavns"
_NAME: Final = re.compile(_PREFIX + r"-(\d+)-\d+")
_numbers = count()
_CLONE_NEWNET: Final = 0x40000000
_TUNSETIFF: Final = 0x400454CA
_IFF_TUN_WITHOUT_HEADER: Final = 0x1001
_NETLINK_NETFILTER: Final = 12
_CONNTRACK_DELETE: Final = 1 << 8 | 2
_REQUEST_WITH_ACK: Final = 1 | 4
_BUFFER_BYTES: Final = 1 << 21
_libc = ctypes.CDLL(None, use_errno=True)


class NamespaceError(Exception):
    """A command for a namespace failed. The message is for a person."""


def why_not(*commands: str) -> str | None:
    """What this machine or user lacks for namespaces and these commands, or None."""
    if os.geteuid():
        return "root, to make network namespaces"
    missing = [command for command in ("ip", *commands) if shutil.which(command) is None]
    if missing:
        return f"{', '.join(missing)} (Debian: iproute2, nftables, util-linux)"
    try:
        with Namespace():
            return None
    except NamespaceError as error:
        return f"network namespaces: {error}"


def need_namespaces(*commands: str) -> None:
    """Skip a test without them."""
    reason = why_not(*commands)
    need(reason is None, reason or "")


def remove_leftovers() -> None:
    """Remove the namespaces of killed processes, and end what runs in them."""
    for line in _run("ip", "netns", "list").splitlines():
        match = _NAME.match(line)
        if match and not Path("/proc", match[1]).exists():
            _remove(match[0])


class Namespace:
    """A host or a router, from :meth:`open` to :meth:`close`, or as a context."""

    def __init__(self) -> None:
        self.name = f"{_PREFIX}-{os.getpid()}-{next(_numbers)}"
        self.path = Path("/run/netns", self.name)
        self.launcher = ("ip", "netns", "exec", self.name)
        """Put before a command, it runs the command there."""

    def open(self, *, forwards: bool = False) -> None:
        """Make it. A router forwards, and accepts packets from anywhere."""
        _run("ip", "netns", "add", self.name)
        self.ip("link set lo up")
        with self.entered():
            for name, value in (
                ("ipv4/ip_forward", 1),
                ("ipv4/conf/all/rp_filter", 0),
                ("ipv4/conf/default/rp_filter", 0),
                ("ipv6/conf/all/forwarding", 1),
            ) * forwards:
                with suppress(FileNotFoundError):  # a kernel without IPv6
                    Path("/proc/sys/net", name).write_text(str(value))

    def close(self) -> None:
        """End the processes in it, and remove it, however much of it there is."""
        _remove(self.name)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def entered(self) -> Iterator[None]:
        """This thread makes sockets and processes there; those stay there. Not across an ``await`` without a lock."""
        with entered(self.path):
            yield

    def ip(self, *lines: str) -> None:
        """Commands of ``ip``, all in one process."""
        _run("ip", "-n", self.name, "-batch", "-", text="\n".join(lines))

    def run(self, *command: str) -> str:
        """Run a command there to its end; returns its output. Raises NamespaceError if it failed."""
        return _run(*self.launcher, *command)

    def nft(self, rules: str) -> None:
        """Add these rules."""
        _run(*self.launcher, "nft", "-f", "-", text=f"{rules}\n")

    def open_tun(self, device: str) -> int:
        """A new TUN interface; it ends with its descriptor."""
        with self.entered():
            tun = os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC)
            fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _IFF_TUN_WITHOUT_HEADER))
            with suppress(FileNotFoundError):
                Path("/proc/sys/net/ipv6/conf", device, "disable_ipv6").write_text("1")
        self.ip(f"link set {device} up")
        return tun

    def forget_connections(self) -> None:
        """Empty Linux's connection tracking there, as ``conntrack -F`` does."""
        with self.entered(), socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_NETFILTER) as netlink:
            body = struct.pack("BBH", socket.AF_UNSPEC, 0, 0)
            netlink.send(struct.pack("IHHII", 16 + len(body), _CONNTRACK_DELETE, _REQUEST_WITH_ACK, 0, 0) + body)
            (error,) = struct.unpack_from("i", netlink.recv(4096), 16)
        if error:
            raise NamespaceError(f"connection tracking of {self.name} not emptied: {os.strerror(-error)}")


def connect(upper: Namespace, device: str, lower: Namespace, lower_device: str = "wan") -> None:
    """Lay a cable from an interface of the upper namespace to one of the lower one."""
    lower.ip(
        f"link add {lower_device} type veth peer name {device} netns {upper.name}", f"link set {lower_device} up"
    )
    upper.ip(f"link set {device} up")


@contextmanager
def entered(namespace: Path) -> Iterator[None]:
    """This thread is in a namespace, given by its file."""
    with Path("/proc/thread-self/ns/net").open() as own, namespace.open() as there:
        _enter(there.fileno())
        try:
            yield
        finally:
            _enter(own.fileno())


def udp_socket_in(namespace: Path, address: str = "127.0.0.1", port: int = 0) -> socket.socket:
    """A UDP socket in a namespace, which does not wait, with room for bursts."""
    with entered(namespace):
        made = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    made.setblocking(False)
    made.bind((address, port))
    return made


def _enter(descriptor: int) -> None:
    if _libc.setns(descriptor, _CLONE_NEWNET):
        raise NamespaceError(f"setns failed: {os.strerror(ctypes.get_errno())}")


def _remove(name: str) -> None:
    for pid in _run("ip", "netns", "pids", name, check=False).split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    _run("ip", "netns", "delete", name, check=False)


def _run(*command: str, text: str = "", check: bool = True) -> str:
    ended = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if check and ended.returncode:
        raise NamespaceError(f"`{' '.join(command)}` failed: {(ended.stderr or ended.stdout).strip()}")
    return ended.stdout
