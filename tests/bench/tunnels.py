"""VPNs with keys made for the run: the generator sends straight to the right host's tunnel address."""

from __future__ import annotations

import os
import subprocess
from abc import abstractmethod
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable, Host
from tests.bench.contenders import (
    LINK_PORT,
    Contender,
    NotMeasuredError,
    Running,
    command_version,
    needs_command,
    until,
)
from tests.bench.traffic import SINK_PORT

LEFT_TUNNEL: Final = "10.214.0.1"
RIGHT_TUNNEL: Final = "10.214.0.2"
TUN: Final = Path("/dev/net/tun")


class Tunnel(Contender):
    """A VPN between the two hosts."""

    def __init__(self, command: str, *others: str, version_option: str = "--version") -> None:
        super().__init__(command)
        self._commands = (command, *others)
        self._version_option = version_option

    def why_not(self) -> str | None:
        return needs_command(*self._commands) or _why_no_tun()

    def version(self) -> str | None:
        return command_version(self.name, self._version_option)

    def start(self, cable: Cable, folder: Path) -> Running:
        try:
            left, right = self._start(cable, folder)
        except (OSError, subprocess.CalledProcessError) as error:
            raise NotMeasuredError(f"it cannot be set up: {error}") from None
        return Running([left], [right], (RIGHT_TUNNEL, SINK_PORT))

    @abstractmethod
    def _start(self, cable: Cable, folder: Path) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """Both sides."""


def _why_no_tun() -> str | None:
    try:
        os.close(os.open(TUN, os.O_RDWR))
    except OSError as error:
        return f"no tunnels here: {TUN}: {error.strerror}"
    return None


class WireguardGo(Tunnel):
    """WireGuard in user space."""

    def _start(self, cable: Cable, folder: Path) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        private = [_output("wg", "genkey") for _ in range(2)]
        public = [_output("wg", "pubkey", given=key) for key in private]
        left = self._side(cable.left, folder, private[0], public[1], RIGHT_TUNNEL, cable.right.address)
        right = self._side(cable.right, folder, private[1], public[0], LEFT_TUNNEL, cable.left.address)
        return left, right

    def _side(
        self, host: Host, folder: Path, private: str, public: str, other: str, endpoint: str
    ) -> subprocess.Popen[bytes]:
        is_left = other == RIGHT_TUNNEL
        side = "left" if is_left else "right"
        device = f"wg{os.getpid() % 10**8}{side[0]}"  # its control socket is the machine's, so the name is too
        process = host.start(["wireguard-go", "-f", device], log=folder / f"{side}.log")
        config = folder / f"{side}.conf"
        config.touch(0o600)
        config.write_text(
            f"[Interface]\nPrivateKey = {private}\nListenPort = {LINK_PORT}\n"
            f"[Peer]\nPublicKey = {public}\nAllowedIPs = {other}/32\nEndpoint = {endpoint}:{LINK_PORT}\n"
        )
        _until_device(host, device, process)
        host.run("wg", "setconf", device, str(config))
        address = LEFT_TUNNEL if is_left else RIGHT_TUNNEL
        host.run("ip", "address", "add", f"{address}/24", "dev", device)
        host.run("ip", "link", "set", device, "up", "mtu", "1420")
        return process


class Nebula(Tunnel):
    """Nebula, an overlay with certificates, the right host as lighthouse."""

    def _start(self, cable: Cable, folder: Path) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        _command(folder, "nebula-cert", "ca", "-name", "bench")
        for side, address in (("left", LEFT_TUNNEL), ("right", RIGHT_TUNNEL)):
            _command(folder, "nebula-cert", "sign", "-name", side, "-ip", f"{address}/24")
            (folder / f"{side}.yml").write_text(self._config(side, cable.right.address))
        right = cable.right.start(["nebula", "-config", "right.yml"], folder=folder, log=folder / "right.log")
        left = cable.left.start(["nebula", "-config", "left.yml"], folder=folder, log=folder / "left.log")
        for host, process in ((cable.left, left), (cable.right, right)):
            _until_device(host, "nebula1", process)
        return left, right

    @staticmethod
    def _config(side: str, lighthouse: str) -> str:
        known = f'static_host_map:\n  "{RIGHT_TUNNEL}": ["{lighthouse}:{LINK_PORT}"]\n' if side == "left" else ""
        hosts = f'  hosts: ["{RIGHT_TUNNEL}"]\n' if side == "left" else ""
        return (
            f"pki: {{ca: ca.crt, cert: {side}.crt, key: {side}.key}}\n{known}"
            f"lighthouse:\n  am_lighthouse: {'false' if side == 'left' else 'true'}\n{hosts}"
            f"listen: {{host: 0.0.0.0, port: {LINK_PORT}}}\ntun: {{dev: nebula1, mtu: 1300}}\n"
            "firewall:\n  outbound: [{port: any, proto: any, host: any}]\n"
            "  inbound: [{port: any, proto: any, host: any}]\n"
        )


def _until_device(host: Host, device: str, process: subprocess.Popen[bytes]) -> None:
    def is_there() -> bool:
        if process.poll() is not None:
            raise NotMeasuredError(f"it ended with status {process.returncode}")
        return device in host.run("ip", "-o", "link", "show")

    until(is_there, f"the device {device} is there")


def _command(folder: Path, *command: str) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


def _output(*command: str, given: str = "") -> str:
    return subprocess.run(command, input=given, check=True, capture_output=True, text=True).stdout.strip()


TUNNELS: Final = (
    WireguardGo("wireguard-go", "wg"),
    Nebula("nebula", "nebula-cert", version_option="-version"),
)
