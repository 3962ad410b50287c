"""Keys in the wrong place: a private key or a PSK as a public key, a public key as a private one, an example's key.

No message repeats a key. A private key in a configuration is exposed, because that file is shown, copied and sent:
the remedy is always a new key.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from uavlinkd.config.keys import KEY_TEXT_LENGTH, decode_key, encode_key, looks_private
from uavlinkd.config.problems import Found, Sections, Values
from uavlinkd.core.crypto import x25519_public_key

EXAMPLE_KEYS = frozenset(
    {
        "+GGI0JkL0+3mJYG9RxFCI7crgfpQ7epbNx8UmBAYcGQ=",
        "Is+OSCKTa6Id2wymhOZXYuDCPcfLOHGwnYi5Ai117ls=",
        "Ya1BcyCMNCoxhVU/dI5z9wlfOD9PHricYw/gaSC3swU=",
        "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE=",
    }
)
"""The public keys in README.md and configs/. Their private keys do not exist. A test compares this list with them."""
_MAX_FILES = 512
_EXPOSED = "it is exposed: make a new one there with `uavlinkd keygen`, and write here the public key that it prints"


def check(file: Sections) -> Found:
    """Yield a problem for each key that is certainly in the wrong place."""
    files = _key_files(file.folder)
    owners = {peer.valid["public_key"]: peer.get("name", "") for peer in file.others if "public_key" in peer.valid}
    psks = [file.secret(peer, "psk_file") for peer in file.others]
    private, public = file.secret(file.top, "private_key_file"), file.own_key()
    for peer in file.others:
        if (key := peer.get("public_key")) is None:
            continue
        place, half = peer.at("public_key"), x25519_public_key(key) if private else None
        if private and key == private.reveal() and not looks_private(key):
            text = f"holds the public key of {peer.at()}, not a private key: make this daemon's own with"
            yield "private_key_file", f"{text} `uavlinkd keygen`"
        elif private and key == private.reveal():
            yield (
                place,
                "is this daemon's private key, which must stay secret, and is exposed: move its file away, make a new"
                " one with `uavlinkd keygen`, and write here what `uavlinkd pubkey` prints on the peer",
            )
        elif any(psk is not None and key == psk.reveal() for psk in psks):
            yield (
                place,
                "is a PSK, which must stay secret: make a new PSK with `uavlinkd psk`, and write here what"
                " `uavlinkd pubkey` prints on the peer",
            )
        elif half is not None and half == public:
            yield place, f"is this daemon's private key, which must stay secret; {_EXPOSED}"
        elif half in owners:
            yield place, f'is the private key of peer "{owners[half]}", which must stay secret; {_EXPOSED}'
        elif key in files:
            yield place, f"is the secret key in {files[key]}, which must stay secret; {_EXPOSED}"


def _key_files(folder: Path) -> Mapping[bytes, str]:
    """The keys in the small files of a folder, with the names of the files. In ``.pub`` people keep public keys."""
    keys: dict[bytes, str] = {}
    with suppress(OSError):
        for number, path in enumerate(folder.iterdir()):
            if number == _MAX_FILES:
                break
            with suppress(OSError, ValueError):
                status = path.lstat()
                if stat.S_ISREG(status.st_mode) and KEY_TEXT_LENGTH <= status.st_size <= KEY_TEXT_LENGTH + 4:
                    key = decode_key(path.read_text(encoding="ascii"))
                    if path.suffix != ".pub" or looks_private(key):
                        keys[key] = path.name
    return keys


def advice(private: bytes, owners: Iterable[Values]) -> Iterator[str]:
    """Yield a warning for each key that is probably in the wrong place. ``owners``: the sections with public keys."""
    if not looks_private(private):
        yield (
            "private_key_file holds a key without the form of a private key, perhaps a public key: make one with"
            " `uavlinkd keygen`, unless software other than `uavlinkd` and `wg` made it"
        )
    for owner in owners:
        key, what = owner.valid["public_key"], owner.section.partition("[")[0]
        name = f'{what} "{owner.valid["name"]}": public_key'
        if encode_key(key) in EXAMPLE_KEYS:
            yield (
                f"{name} is the key of an example, whose private key does not exist: write what `uavlinkd keygen` or"
                f" `uavlinkd pubkey` printed on the {what}"
            )
        elif looks_private(key):
            yield (
                f"{name} has the form of a private key. `uavlinkd keygen` makes no such public key, `wg` one of 16:"
                f" compare it with what `uavlinkd pubkey FILE` prints on the {what}. If it is its private key,"
                f" {_EXPOSED}"
            )
