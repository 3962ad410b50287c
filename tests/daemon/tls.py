"""Relays that listen for TLS, and certificates for them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from tests.daemon.process import DaemonProcess
from uavlinkd.lab.sim.loopback_ports import free_port


def write_certificate(folder: Path) -> None:
    """A self-signed certificate ``tls.crt`` and its key ``tls.key``."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "relay")])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    signed = (
        builder.not_valid_before(now - timedelta(1)).not_valid_after(now + timedelta(1)).sign(key, hashes.SHA256())
    )
    (folder / "tls.crt").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    pkcs8, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    (folder / "tls.key").write_bytes(key.private_bytes(serialization.Encoding.PEM, pkcs8, plain))


def listen_for_tls(relay: DaemonProcess, host: str = "127.0.0.1", port: int = 0) -> str:
    """Have a relay listen for TLS too. Returns its URL."""
    write_certificate(relay.folder)
    listen = f"{host}:{port or free_port()}"
    relay.config["relay_server"] = {"https": {"listen": listen, "certificate": "tls.crt", "key": "tls.key"}}
    return f"wss://{listen}/uavlink"
