"""Keys in the wrong place: a private key or a PSK as a public key, a public key as a private one, an example's key.

No message repeats a key. A private key in a configuration is exposed, because that file is shown, copied and sent:
the remedy is always a new key.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from uavlinkd.config.keys import KEY_TEXT_LENGTH, decode_key, encode_key, looks_private
from uavlinkd.config.problems import Problems, Values
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


def check(
    problems: Problems, peers: Sequence[Values], private: bytes | None, psks: Sequence[bytes | None], folder: Path
) -> None:
    """Add a problem for each key that is certainly in the wrong place."""
    files = _key_files(folder)
    owners = {peer.valid["public_key"]: peer.valid.get("name", "") for peer in peers if "public_key" in peer.valid}
    for peer in peers:
        key = peer.valid.get("public_key")
        if key is None:
            continue
        place = peer.place.key("public_key")
        if key == private:
            _add_own(problems, place, peer, is_private=looks_private(key))
        elif key in [psk for psk in psks if psk is not None]:
            problems.add(
                place,
                "is a PSK, which must stay secret: make a new PSK with `uavlinkd psk`, and write here what"
                " `uavlinkd pubkey` prints on the peer",
            )
        elif private is not None and (half := x25519_public_key(key)) == x25519_public_key(private):
            problems.add(place, f"is this daemon's private key, which must stay secret; {_EXPOSED}")
        elif private is not None and half in owners:
            problems.add(place, f'is the private key of peer "{owners[half]}", which must stay secret; {_EXPOSED}')
        elif key in files:
            problems.add(place, f"is the secret key in {files[key]}, which must stay secret; {_EXPOSED}")


def _add_own(problems: Problems, place: str, peer: Values, *, is_private: bool) -> None:
    if is_private:
        problems.add(
            place,
            "is this daemon's private key, which must stay secret, and is exposed: move its file away, make a new one"
            " with `uavlinkd keygen`, and write here what `uavlinkd pubkey` prints on the peer",
        )
    else:
        problems.add(
            "private_key_file",
            f"holds the public key of {peer.place.key('').removeprefix('.')}, not a private key: make this daemon's"
            " own with `uavlinkd keygen`",
        )


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


def advice(private: bytes, owners: Iterable[tuple[str, str, bytes]]) -> Iterator[str]:
    """Yield a warning for each key that is probably in the wrong place.

    ``owners``: for each public key what it is the key of, such as a peer, and that one's name.
    """
    if not looks_private(private):
        yield (
            "private_key_file holds a key without the form of a private key, perhaps a public key: make one with"
            " `uavlinkd keygen`, unless software other than `uavlinkd` and `wg` made it"
        )
    for what, name, key in owners:
        if encode_key(key) in EXAMPLE_KEYS:
            yield (
                f'{what} "{name}": public_key is the key of an example, whose private key does not exist: write'
                f" what `uavlinkd keygen` or `uavlinkd pubkey` printed on the {what}"
            )
        elif looks_private(key):
            yield (
                f'{what} "{name}": public_key has the form of a private key. `uavlinkd keygen` makes no such'
                f" public key, `wg` one of 16: compare it with what `uavlinkd pubkey FILE` prints on the {what}."
                f" If it is its private key, {_EXPOSED}"
            )
