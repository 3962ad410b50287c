"""Certificates, bulletins and their records as test vectors, made by the second implementation (`independent_fleet`).

python -m tests.protocol.fleet_vectors          writes tests/vectors/fleet.json again
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tests.protocol import independent_fleet
from tests.protocol.independent_fleet import OBSERVER, OPERATOR, RELAY, VEHICLE, Bulletin, Certificate

PATH = Path(__file__).parents[1] / "vectors" / "fleet.json"
ABOUT = (
    "Certificates, bulletins and records of uavlinkd/authority/README.md, made by"
    " tests/protocol/independent_fleet.py: `python -m tests.protocol.fleet_vectors`."
    " Byte strings in hex. A certificate is for the key `public`; its fields:"
    " serial, role, first and last system id, name. Fields of a bulletin: number, least serial, revoked serials."
)
AUTHORITY = Ed25519PrivateKey.from_private_bytes(hashlib.sha256(b"authority").digest())
AUTHORITY_PUBLIC = AUTHORITY.public_key().public_bytes_raw()
FLEET = independent_fleet.fleet_id(AUTHORITY_PUBLIC)
CERTIFICATES = (
    Certificate(FLEET, 1, RELAY, 0, 0, "relay"),
    Certificate(FLEET, 7, VEHICLE, 7, 7, "v"),
    Certificate(FLEET, 0x01020304, OPERATOR, 254, 255, "ground-station-000021"),
    Certificate(FLEET, 2**32 - 1, OBSERVER, 1, 255, "0-9"),
)
BULLETINS = (
    Bulletin(FLEET, 1, 1),
    Bulletin(FLEET, 1 << 24 | 2, 100, (100, 101, 100 + 65535)),
    Bulletin(FLEET, 2**32 - 1, 2**32 - 92, tuple(range(2**32 - 92, 2**32))),
)


def make() -> dict[str, object]:
    """The content of the file."""
    certificates, bulletins = [], []
    records = {"who": independent_fleet.who(VEHICLE, OPERATOR, after=7)}
    for certificate in CERTIFICATES:
        static = hashlib.sha256(f"static key of {certificate.name}".encode()).digest()
        public = X25519PrivateKey.from_private_bytes(static).public_key().public_bytes_raw()
        data = certificate.signed(AUTHORITY, public)
        records["certificate"] = independent_fleet.certificate_record(public, data)
        entry = {"static": static.hex(), "public": public.hex(), "fields": certificate[1:], "bytes": data.hex()}
        certificates.append(entry)
    for bulletin in BULLETINS:
        data = bulletin.signed(AUTHORITY)
        records["bulletin"] = independent_fleet.bulletin_record(data)
        records["have"] = independent_fleet.have(data, own_serial=7, known=1)
        bulletins.append({"fields": bulletin[1:], "bytes": data.hex()})
    return {
        "about": ABOUT,
        "authority_private": AUTHORITY.private_bytes_raw().hex(),
        "authority_public": AUTHORITY_PUBLIC.hex(),
        "fleet": FLEET.hex(),
        "certificates": certificates,
        "bulletins": bulletins,
        "records": {name: record.hex() for name, record in records.items()},
    }


def main() -> None:
    """Write the file."""
    PATH.write_text(json.dumps(make(), indent=1) + "\n")


if __name__ == "__main__":
    main()
