"""Real HTTP proxies: processes of Debian's packages."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from time import monotonic
from typing import Final

from tests.needs import need
from tests.waiting import PATIENCE_S
from uavlinkd.lab.child_processes import end_with_parent, stop_child
from uavlinkd.lab.sim.loopback_ports import free_port

USER, PASSWORD = "member", "secret"
"""That tinyproxy wants."""
_SBIN: Final = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin"))
_END_S: Final = 10.0

_TINYPROXY = """
Listen 127.0.0.1
Port {port}
Allow 127.0.0.1
BasicAuth {user} {password}
ConnectPort {to}
"""
_SQUID = """
http_port 127.0.0.1:{port}
acl relay port {to}
http_access allow CONNECT relay
http_access deny all
cache deny all
cache_effective_user proxy
pinger_enable off
access_log none
cache_log /dev/null
pid_filename none
coredump_dir none
shutdown_lifetime 0 seconds
"""


class WebServer:
    """A process that listens on a port of loopback. ``command`` and files are complete before :meth:`start`."""

    def __init__(self, executable: str, folder: Path, *arguments: str) -> None:
        need(shutil.which(executable, path=_SBIN) is not None, f"{executable}, a package of Debian")
        self.port = free_port()
        self.folder = folder
        self._command = (executable, *arguments)
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Return when it accepts connections."""
        assert self._process is None
        environ = {**os.environ, "PATH": _SBIN, "HOME": str(self.folder)}
        command = end_with_parent(*self._command)
        self._process = await asyncio.create_subprocess_exec(*command, env=environ, cwd=self.folder)
        give_up_at = monotonic() + PATIENCE_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port)).close()
            except OSError:
                assert monotonic() < give_up_at
                assert self._process.returncode is None, f"{self._command[0]} ended"
                await asyncio.sleep(0.02)
            else:
                return

    async def stop(self) -> None:
        if self._process is not None:
            await stop_child(self._process, signal.SIGTERM, _END_S)
            self._process = None


def _write(folder: Path, **files: str) -> None:
    folder.mkdir()
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)


def tinyproxy(folder: Path, to: int) -> WebServer:
    """Connects to this port only, for a user with a password."""
    server = WebServer("tinyproxy", folder, "-d", "-c", f"{folder}/tinyproxy.conf")
    _write(folder, tinyproxy_conf=_TINYPROXY.format(port=server.port, to=to, user=USER, password=PASSWORD))
    return server


def squid(folder: Path, to: int) -> WebServer:
    """Connects to this port only."""
    server = WebServer("squid", folder, "-N", "-f", f"{folder}/squid.conf")
    _write(folder, squid_conf=_SQUID.format(port=server.port, to=to))
    return server


@asynccontextmanager
async def running(make: Callable[[Path, int], WebServer], folder: Path, to: int) -> AsyncIterator[WebServer]:
    """A server of this kind in a new folder, for a relay on this port."""
    server = make(folder, to)
    try:
        await server.start()
        yield server
    finally:
        await server.stop()
