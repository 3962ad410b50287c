"""MAVLink routers: MAVProxy, and a typical script that signs frames with pymavlink."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable, Host
from tests.bench.contenders import INTO_PORT, LINK_PORT, Contender, Running, needs_module
from tests.bench.traffic import REPOSITORY, SINK_PORT


class Router(Contender):
    """A router of a Python package."""

    def __init__(self, name: str, package: str) -> None:
        super().__init__(name)
        self._package = package

    def why_not(self) -> str | None:
        return needs_module(self._package)

    def version(self) -> str | None:
        return version(self._package)


class Mavproxy(Router):
    """MAVProxy on both hosts, without console, map and modules; it logs as it always does."""

    def start(self, cable: Cable, folder: Path) -> Running:
        right = self._side(cable.right, folder / "right", f"0.0.0.0:{LINK_PORT}", f"127.0.0.1:{SINK_PORT}")
        left = self._side(cable.left, folder / "left", f"127.0.0.1:{INTO_PORT}", f"{cable.right.address}:{LINK_PORT}")
        return Running([left], [right])

    @staticmethod
    def _side(host: Host, folder: Path, into: str, out: str) -> subprocess.Popen[bytes]:
        folder.mkdir()
        script = Path(sys.executable).with_name("mavproxy.py")
        options = ("--daemon", "--non-interactive", "--streamrate=-1", "--default-modules=", "--mav20")
        return host.start(
            [sys.executable, str(script), f"--master=udpin:{into}", f"--out=udpout:{out}", *options],
            folder=folder,
            log=folder / "mavproxy.log",
            environ={"HOME": str(folder)},
        )


class PymavlinkSigning(Router):
    """The relays of :mod:`tests.bench.signing`: the left one signs, the right one accepts only signed frames."""

    def start(self, cable: Cable, folder: Path) -> Running:
        key = folder / "signing.key"
        key.touch(0o600)
        key.write_bytes(os.urandom(32))
        verify = (f"udpin:0.0.0.0:{LINK_PORT}", f"udpout:127.0.0.1:{SINK_PORT}")
        sign = (f"udpin:127.0.0.1:{INTO_PORT}", f"udpout:{cable.right.address}:{LINK_PORT}")
        right = self._side(cable.right, "verify", verify, key, folder / "right.log")
        return Running([self._side(cable.left, "sign", sign, key, folder / "left.log")], [right])

    @staticmethod
    def _side(host: Host, what: str, urls: Sequence[str], key: Path, log: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.bench.signing", what, *urls, str(key)]
        return host.start(command, folder=REPOSITORY, log=log, environ={"MAVLINK20": "1"})


ROUTERS: Final = (Mavproxy("mavproxy", "MAVProxy"), PymavlinkSigning("pymavlink-signing", "pymavlink"))
