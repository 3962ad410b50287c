"""Certificates for tests. Members do not check them, so they name no host."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

CERTIFICATE, TLS_KEY = "tls.crt", "tls.key"


def write_tls_files(
    folder: Path,
    certificate: str = CERTIFICATE,
    key: str = TLS_KEY,
    passphrase: bytes = b"",
) -> None:
    """A certificate and its key. It has expired: members do not mind."""
    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "relay")])
    then = datetime.now(UTC) - timedelta(days=9)
    until = then + timedelta(days=1)
    signed = (
        x509.CertificateBuilder(name, name, private.public_key(), x509.random_serial_number())
        .not_valid_before(then)
        .not_valid_after(until)
        .sign(private, hashes.SHA256())
    )
    protection = serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
    pem, form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (folder / certificate).write_bytes(signed.public_bytes(pem))
    (folder / key).write_bytes(private.private_bytes(pem, form, protection))
