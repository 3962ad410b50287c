"""VPNs with keys made for the run: the generator sends straight to the right host's tunnel address."""

from __future__ import annotations

import os
import subprocess
from abc import abstractmethod
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable, Host
from tests.bench.contenders import (
    INTO,
    INTO_PORT,
    LINK_PORT,
    Contender,
    NotMeasuredError,
    Relay,
    Running,
    command_version,
    needs_command,
    until,
)
from tests.bench.daemons import configuration, start_daemon
from tests.bench.traffic import SINK_PORT
from uavlinkd.config import keys

LEFT_TUNNEL: Final = "10.214.0.1"
RIGHT_TUNNEL: Final = "10.214.0.2"
NETWORK: Final = "10.214.0.0/24"
TUN: Final = Path("/dev/net/tun")


class Tunnel(Contender):
    """A VPN between the two hosts."""

    def __init__(self, name: str, *commands: str, version_option: str = "--version") -> None:
        super().__init__(name)
        self._commands = commands
        self._version_option = version_option

    def why_not(self) -> str | None:
        return needs_command(*self._commands) or _why_no_tun()

    def version(self) -> str | None:
        return command_version(self._commands[0], self._version_option)

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
        address = LEFT_TUNNEL if other == RIGHT_TUNNEL else RIGHT_TUNNEL
        return start_wireguard(
            host, folder, private, public, (address, other), f"Endpoint = {endpoint}:{LINK_PORT}\n"
        )


class WireguardGoBehindRelay(WireguardGo):
    """wireguard-go with the empty relay before it, which receives frames on loopback as a daemon does."""

    def why_not(self) -> str | None:
        return super().why_not() or Relay("relay").why_not()

    def start(self, cable: Cable, folder: Path) -> Running:
        running = super().start(cable, folder)
        relay = Relay("relay").start_one(cable.left, INTO_PORT, running.target, folder)
        return Running([*running.left, relay], running.right, INTO)


class Station(Tunnel):
    """The vehicle's daemon with a station: WireGuard in its own process, wireguard-go at the other end."""

    def start(self, cable: Cable, folder: Path) -> Running:
        running = super().start(cable, folder)
        return Running(running.left, running.right, INTO)

    def _start(self, cable: Cable, folder: Path) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        for name in ("left", "stations"):
            keys.write_secret_file(folder / f"{name}.key", _output("wg", "genkey") + "\n")
        own = keys.public_key_text((folder / "stations.key").read_text().strip())
        private = _output("wg", "genkey")
        station = (
            f'\n[stations]\nlisten = "0.0.0.0:{LINK_PORT + 1}"\nprivate_key_file = "stations.key"\nnetwork ='
            f' "{NETWORK}"\n\n[[station]]\nname = "right"\npublic_key = "{keys.public_key_text(private)}"\n'
            f'address = "{RIGHT_TUNNEL}"\nrole = "operator"\nsystem_ids = [255]\nports = [{SINK_PORT}]\n'
        )
        endpoint = f"udpin:127.0.0.1:{INTO_PORT}"
        (folder / "left.toml").write_text(configuration("left", peers=[station], endpoint=endpoint))
        left = start_daemon(cable.left, folder / "left.toml")
        until((folder / "left.sock").exists, "the daemon answers")
        place = f"Endpoint = {cable.left.address}:{LINK_PORT + 1}\nPersistentKeepalive = 15\n"
        return left, start_wireguard(cable.right, folder, private, own, (RIGHT_TUNNEL, LEFT_TUNNEL), place)


def start_wireguard(
    host: Host, folder: Path, private: str, public: str, addresses: tuple[str, str], more: str
) -> subprocess.Popen[bytes]:
    """An interface of wireguard-go with one peer; ``addresses``: its own one and the peer's inside the tunnel."""
    own, other = addresses
    device = f"wg{os.getpid() % 10**8}{host.name[-1]}"  # its control socket is the machine's, so the name is too
    process = host.start(["wireguard-go", "-f", device], log=folder / f"{device}.log")
    config = folder / f"{device}.conf"
    config.touch(0o600)
    config.write_text(
        f"[Interface]\nPrivateKey = {private}\nListenPort = {LINK_PORT}\n"
        f"[Peer]\nPublicKey = {public}\nAllowedIPs = {other}/32\n{more}"
    )
    _until_device(host, device, process)
    host.run("wg", "setconf", device, str(config))
    host.run("ip", "address", "add", f"{own}/24", "dev", device)
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
    WireguardGo("wireguard-go", "wireguard-go", "wg"),
    WireguardGoBehindRelay("wireguard-go-relay", "wireguard-go", "wg"),
    Station("uavlinkd-station", "wireguard-go", "wg"),
    Nebula("nebula", "nebula", "nebula-cert", version_option="-version"),
)
