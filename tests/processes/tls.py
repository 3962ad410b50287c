"""Relays that listen for TLS."""

from __future__ import annotations

from tests.processes.process import DaemonProcess
from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from uavlinkd.lab.sim.loopback_ports import free_port


def listen_for_tls(relay: DaemonProcess, host: str = "127.0.0.1", port: int = 0) -> str:
    """Have a relay listen for TLS too. Returns its URL."""
    write_tls_files(relay.folder)
    listen = f"{host}:{port or free_port()}"
    relay.config["relay_server"] = {"https": {"listen": listen, "certificate": CERTIFICATE, "key": TLS_KEY}}
    return f"wss://{listen}/uavlink"
