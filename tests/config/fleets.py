"""Configuration files of members of a fleet with an authority."""

from __future__ import annotations

from base64 import b64decode
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.authority.signing import SIGNER
from tests.config.files import ENDPOINT, HEAD, KEY
from uavlinkd.authority.certificates import Bulletin, Certificate, MemberRole, fleet_id_of
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config
from uavlinkd.system.base64_text import to_base64

OTHER_SIGNER = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PRIVATE = to_base64(b"\x08" * 31 + b"\x48")
OWN = keys.public_key_text(PRIVATE)


def authority(signer: Ed25519PrivateKey = SIGNER) -> bytes:
    return signer.public_key().public_bytes_raw()


def certificate(
    role: MemberRole = MemberRole.VEHICLE,
    name: str = "v7",
    ids: tuple[int, int] = (7, 7),
    *,
    key: str = OWN,
    serial: int = 7,
    signer: Ed25519PrivateKey = SIGNER,
) -> str:
    """A signed certificate, in base64."""
    ids = (0, 0) if role == MemberRole.RELAY else ids
    made = Certificate(fleet_id_of(authority(signer)), serial, role, ids, name)
    return to_base64(made.encode() + signer.sign(made.to_be_signed(b64decode(key))))


def bulletin(number: int = 1, *revoked: int, signer: Ed25519PrivateKey = SIGNER) -> str:
    """A signed bulletin, in base64."""
    made = Bulletin(fleet_id_of(authority(signer)), number, 0, revoked)
    return to_base64(made.encode() + signer.sign(made.to_be_signed()))


def fleet(own: str = "", more: str = "", *, news: str = "") -> str:
    """The section of a vehicle, or of the member with another certificate."""
    return (
        f'[fleet]\nauthority = "{to_base64(authority())}"\ncertificate = "{own or certificate()}"\n'
        f'bulletin = "{news or bulletin()}"\n{more}\n'
    )


def contact(
    role: MemberRole = MemberRole.OPERATOR, name: str = "gs", *, signed: str = "", address: str = "", more: str = ""
) -> str:
    """A section of a contact with system id 200. Its key is that of ``vps``, a relay's that of ``b``."""
    key = KEY["b" if role == MemberRole.RELAY else "vps"]
    made = signed or certificate(role, name, (200, 200), key=key, serial=2)
    at = address or f'["{name}.example.org:5790"]'
    return f'[[contact]]\npublic_key = "{key}"\ncertificate = "{made}"\naddresses = {at}\n{more}\n'


def member_file(sections: str, head: str = HEAD) -> str:
    """A file with an endpoint and confidential links."""
    return f"{head}[link]\nconfidential = true\n{ENDPOINT}{sections}"


def load_member(folder: Path, text: str, environ: dict[str, str] | None = None) -> Config:
    """Load a text beside the private key of :data:`OWN`."""
    if not (folder / "drone0.key").exists():
        keys.write_secret_file(folder / "drone0.key", PRIVATE)
    path = folder / "v7.toml"
    path.write_text(text)
    return load_config(path, environ or {})
