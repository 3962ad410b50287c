"""Rules about ``[[relay]]``, and which peers use which relays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from uavlinkd.config.checks import unique
from uavlinkd.config.model import RelayConfig
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.path import RELAY_HOST
from uavlinkd.core.settings import Link, PeerSettings, Timers

MOST: Final = 3
"""Relays of one daemon. A peer has room for the paths along so many."""
TIMERS: Final = Timers(echo_after_s=0.15, handshake_after_s=0.3, retry_max_s=0.5)
"""A relay is asked when a path along it fails, or once in ten seconds, and answers at once unless it was restarted. A
try costs 0.3 kB: while a relay is down, 5 kbit/s."""


def relays(
    problems: Problems,
    sections: Sequence[Values],
    peers: Sequence[Values],
    members: Sequence[Values],
    own: bytes | None,
) -> None:
    """Each relay has a key and an address of its own, and each relay that a peer names is in the file."""
    if len(sections) > MOST:
        problems.add("relay", f"has {len(sections)} sections: write at most {MOST}, the most reliable ones")
    unique(problems, sections, "name", str, "the name of {other} too: write another")
    unique(problems, sections, "public_key", bytes, "the key of {other} too: each relay has its own")
    owners = {peer.valid[key]: peer for peer in (*members, *peers) for key in _KEYS if key in peer.valid}
    for section in sections:
        place, key = section.place.key("public_key"), section.valid.get("public_key")
        if key is not None and key == own:
            problems.add(place, "is this daemon's own key: write what `uavlinkd pubkey` prints on the relay")
        elif key in owners:
            problems.add(
                place,
                f"is the key of {owners[key].place.key('')} too, and one daemon cannot be both for another one: run"
                " the relay with a key of its own (`uavlinkd keygen`)",
            )
        _addresses(problems, section)
    known = {section.valid["name"] for section in sections if "name" in section.valid}
    for peer in peers if len(known) == len(sections) else ():
        for name in peer.valid.get("relays") or ():
            if name not in known:
                names = ", ".join(f'"{name}"' for name in sorted(known))
                remedy = f"write one of {names}" if names else "add a [[relay]] of that name"
                problems.add(peer.place.key("relays"), f"names a relay that this file does not have: {remedy}")


_KEYS = ("public_key", "previous_public_key")


def _addresses(problems: Problems, section: Values) -> None:
    place, addresses = section.place.key("addresses"), section.valid.get("addresses", ())
    if not addresses and "addresses" not in section.invalid:
        problems.add(
            place, 'is empty, and a relay never initiates: write its address, such as ["relay.example.org:5790"]'
        )
    if any(written.is_serial for written in addresses):
        problems.add(place, "names a serial network, but a relay is reached over IP: write its IP address or name")


def uses_relay(peer: Values, sections: Sequence[Values]) -> bool:
    """Whether a peer uses one of the relays of the file."""
    return bool(sections) and peer.valid.get("relays") != [] and "relays" not in peer.invalid


def relays_of(peer: Values, sections: Sequence[Values]) -> tuple[str, ...]:
    """The names of the relays that a peer uses, in a file without problems."""
    names: list[str] | None = peer.valid.get("relays")
    return tuple(section.valid["name"] for section in sections if names is None or section.valid["name"] in names)


def relay_of(section: Values, psk: Secret | None, link: Values) -> RelayConfig:
    """The relay of a valid section. It inherits the suites of ``[link]``."""
    suites = tuple(LinkSection.model_construct(**link.valid).suites)
    return RelayConfig(
        settings=PeerSettings(
            name=RELAY_HOST + section.valid["name"],
            public_key=section.valid["public_key"],
            psk=psk,
            link=Link(suites, timers=TIMERS, features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS),
        ),
        addresses=tuple(section.valid["addresses"]),
    )
