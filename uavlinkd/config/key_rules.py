"""Rules about keys: each belongs to one daemon. People paste private keys.

No message repeats a key. A private key in a configuration is exposed, because that file is shown, copied and sent:
the remedy is always a new key.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from uavlinkd.config.file import File, Found
from uavlinkd.config.keys import looks_private
from uavlinkd.config.section import Values
from uavlinkd.protocol.crypto import x25519_public_key


def check(file: File) -> Found:
    """No secret key is written as a public one, and no key of this daemon as another's."""
    secret, own = file.top.get("private_key_file"), file.own_key
    for section in file.others if secret is not None else ():
        if section.valid.get("psk_file") == secret:
            text = "holds this daemon's private key, which must stay secret: make a PSK with `uavlinkd psk`"
            yield section.at("psk_file"), text
        if (key := section.get("public_key")) is None:
            continue
        there = f"write what `uavlinkd pubkey` prints on the {section.kind}"
        if key == secret.reveal() and not looks_private(key):
            text = f"holds the public key of {section.at()}, not a private key: make this daemon's own with"
            yield "private_key_file", f"{text} `uavlinkd keygen`"
        elif key == own:
            or_else = f"or private_key_file is that of the {section.kind}: carry each key file to its own machine"
            yield section.at("public_key"), f"is this daemon's own key: {there}; {or_else}"
        elif x25519_public_key(key) == own:
            remedy = f"move its file away, make a new one with `uavlinkd keygen`, and {there}"
            yield section.at("public_key"), f"is this daemon's private key, which must stay secret: {remedy}"


def advice(private: bytes, owners: Iterable[Values]) -> Iterator[str]:
    """Yield a warning for each key that is probably in the wrong place. ``owners``: the sections with public keys."""
    if not looks_private(private):
        yield (
            "private_key_file holds a key without the form of a private key, perhaps a public key: make one with"
            " `uavlinkd keygen`, unless software other than `uavlinkd` and `wg` made it"
        )
    for owner in owners:
        if looks_private(owner.valid["public_key"]):
            what = owner.kind
            yield (
                f'{what} "{owner.valid["name"]}": public_key has the form of a private key. `uavlinkd keygen` makes'
                f" no such public key, `wg` one of 16: compare it with what `uavlinkd pubkey FILE` prints on the"
                f" {what}. If it is its private key, it is exposed: make a new one there with `uavlinkd keygen`, and"
                " write here the public key that it prints"
            )
