"""The network namespaces of a laboratory: hosts and routers."""

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
from typing import Final

_PREFIX: Final = "uavnat"
_NAME: Final = re.compile(_PREFIX + r"-(\d+)-\d+")
_numbers = count()
_CLONE_NEWNET: Final = 0x40000000
_TUNSETIFF: Final = 0x400454CA
_IFF_TUN_WITHOUT_HEADER: Final = 0x1001
_NETLINK_NETFILTER: Final = 12
_CONNTRACK_DELETE: Final = 1 << 8 | 2
_REQUEST_WITH_ACK: Final = 1 | 4
_libc = ctypes.CDLL(None, use_errno=True)


class LaboratoryError(Exception):
    """The laboratory cannot be built. The message is for a person."""


def why_not() -> str | None:
    """What this machine or user lacks for a laboratory, or None."""
    if os.geteuid():
        return "root, to make network namespaces"
    for command, package in (("ip", "iproute2"), ("nft", "nftables")):
        if shutil.which(command) is None:
            return f"`{command}` (package {package})"
    if not Path("/dev/net/tun").exists():
        return "TUN interfaces (/dev/net/tun)"
    probe = Namespace()
    try:
        probe.open()
        probe.nft("add table inet t; add chain inet t c { type nat hook postrouting priority srcnat; }")
    except LaboratoryError as error:
        return f"namespaces with nftables: {error}"
    finally:
        probe.close()
    return None


def remove_leftovers() -> None:
    """Remove the namespaces of laboratories whose process was killed, and end what runs in them."""
    for line in _run("ip", "netns", "list").splitlines():
        match = _NAME.match(line)
        if match and not Path("/proc", match[1]).exists():
            _remove(match[0])


class Namespace:
    """A host or a router. ``wan`` is its interface towards the internet."""

    def __init__(self) -> None:
        self.name = f"{_PREFIX}-{os.getpid()}-{next(_numbers)}"
        self.launcher = ("ip", "netns", "exec", self.name)
        """Put before a command, it runs the command there."""

    def open(self) -> None:
        """Make it. It forwards, and accepts packets from anywhere."""
        _run("ip", "netns", "add", self.name)
        with self.entered():
            for name, value in (
                ("ipv4/ip_forward", 1),
                ("ipv4/conf/all/rp_filter", 0),
                ("ipv4/conf/default/rp_filter", 0),
                ("ipv6/conf/all/forwarding", 1),
            ):
                with suppress(FileNotFoundError):  # a kernel without IPv6
                    Path("/proc/sys/net", name).write_text(str(value))
        self.ip("link set lo up")

    def close(self) -> None:
        """End the processes in it, and remove it, however much of it there is."""
        _remove(self.name)

    @contextmanager
    def entered(self) -> Iterator[None]:
        """This thread makes sockets and processes there; those stay there. Not across an ``await`` without a lock."""
        with Path("/proc/thread-self/ns/net").open() as own, Path("/run/netns", self.name).open() as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(own.fileno())

    def ip(self, *lines: str) -> None:
        """Commands of ``ip``, all in one process."""
        _run("ip", "-n", self.name, "-batch", "-", text="\n".join(lines))

    def nft(self, rules: str) -> None:
        """Add these rules."""
        _run(*self.launcher, "nft", "-f", "-", text=f"{rules}\n")

    def udp_socket(self, address: str = "0.0.0.0", port: int = 0, timeout_s: float | None = None) -> socket.socket:
        """A UDP socket of this host. By default it waits without limit."""
        with self.entered():
            made = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((address, port))
        made.settimeout(timeout_s)
        return made

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
            raise LaboratoryError(f"connection tracking of {self.name} not emptied: {os.strerror(-error)}")


def connect(upper: Namespace, device: str, lower: Namespace, lower_device: str = "wan") -> None:
    """Lay a cable from an interface of the upper namespace to one of the lower one."""
    lower.ip(
        f"link add {lower_device} type veth peer name {device} netns {upper.name}", f"link set {lower_device} up"
    )
    upper.ip(f"link set {device} up")


def _enter(descriptor: int) -> None:
    if _libc.setns(descriptor, _CLONE_NEWNET):
        raise LaboratoryError(f"setns failed: {os.strerror(ctypes.get_errno())}")


def _remove(name: str) -> None:
    for pid in _run("ip", "netns", "pids", name, check=False).split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    _run("ip", "netns", "delete", name, check=False)


def _run(*command: str, text: str = "", check: bool = True) -> str:
    ended = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if check and ended.returncode:
        raise LaboratoryError(f"`{' '.join(command)}` failed: {(ended.stderr or ended.stdout).strip()}")
    return ended.stdout
