"""Rules about ``[[relay]]``, and which peers use which relays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from uavlinkd.config.checks import of_peer, unique
from uavlinkd.config.model import PeerAddress, PeerConfig, RelayConfig
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.path import RELAY_HOST
from uavlinkd.core.settings import Link, PeerSettings, Timers

MOST: Final = 3
"""Relays of one daemon. A peer has room for the paths along so many."""
TIMERS: Final = Timers(echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=1.0, retry_max_s=0.5)
"""A relay is asked when a path along it fails or its peer is silent, and answers at once unless it was restarted. A
try costs 0.3 kB: while a relay is down, 5 kbit/s. When it is lost, its name is resolved again: it may have moved."""


def relays(
    problems: Problems,
    sections: Sequence[Values],
    peers: Sequence[Values],
    members: Sequence[Values],
    own: bytes | None,
) -> None:
    """Each relay has an address, and a key of its own or a peer's. Each relay that a peer names is in the file."""
    if len(sections) > MOST:
        problems.add("relay", f"has {len(sections)} sections: write at most {MOST}, the most reliable ones")
    unique(problems, sections, "name", str, "the name of {other} too: write another")
    unique(problems, sections, "public_key", bytes, "the key of {other} too: each relay has its own")
    by_member = {member.valid["public_key"]: member for member in members if "public_key" in member.valid}
    for section in sections:
        place, key = section.place.key("public_key"), section.valid.get("public_key")
        peer = peer_of(section, peers)
        if key is not None and key == own:
            problems.add(place, "is this daemon's own key: write what `uavlinkd pubkey` prints on the relay")
        elif key in by_member:
            problems.add(
                place,
                f"is the key of {by_member[key].place.key('')} too, and two daemons cannot be relays of each other:"
                " run the relay with a key of its own (`uavlinkd keygen`)",
            )
        if peer is not None:
            of_peer(problems, section, peer)
        _addresses(problems, section, peer)
    _shared_addresses(problems, sections)
    known = {section.valid["name"]: section for section in sections if "name" in section.valid}
    for peer in peers if len(known) == len(sections) else ():
        for name in peer.valid.get("relays") or ():
            if name not in known:
                names = ", ".join(f'"{name}"' for name in sorted(known))
                remedy = f"write one of {names}" if names else "add a [[relay]] of that name"
                problems.add(peer.place.key("relays"), f"names a relay that this file does not have: {remedy}")
            elif peer_of(known[name], [peer]) is not None:
                problems.add(peer.place.key("relays"), f"names {name}, which has this peer's key: leave it out")


def peer_of(section: Values, peers: Sequence[Values]) -> Values | None:
    """The peer with the key of a relay."""
    key = section.valid.get("public_key")
    return next((peer for peer in peers if key is not None and peer.valid.get("public_key") == key), None)


def _addresses(problems: Problems, section: Values, peer: Values | None) -> None:
    place, addresses = section.place.key("addresses"), section.valid.get("addresses", ())
    has_peers = peer is not None and ("addresses" in peer.invalid or bool(_over_ip(peer)))
    if not addresses and not has_peers and "addresses" not in section.invalid:
        problems.add(
            place, 'is empty, and a relay never initiates: write its address, such as ["relay.example.org:5790"]'
        )
    if any(written.is_serial for written in addresses):
        problems.add(place, "names a serial network, but a relay is reached over IP: write its IP address or name")


def _shared_addresses(problems: Problems, sections: Sequence[Values]) -> None:
    """One process answers at an address, with one key."""
    for number, section in enumerate(sections):
        for other in sections[:number]:
            shared = [written for written in _over_ip(section) if written in _over_ip(other)]
            if shared and section.valid.get("public_key") != other.valid.get("public_key"):
                problems.add(
                    section.place.key("addresses"),
                    f"has {shared[0]}, an address of {other.place.key('')} too, which has another key: write the"
                    " address of this relay",
                )


def _over_ip(section: Values) -> list[PeerAddress]:
    return [written for written in section.valid.get("addresses", ()) if not written.is_serial]


def needs_no_address(peer: Values, sections: Sequence[Values]) -> bool:
    """Whether a peer uses a relay of the file, or is one, which has an address."""
    uses_relays = bool(sections) and peer.valid.get("relays") != [] and "relays" not in peer.invalid
    return uses_relays or any(peer_of(section, [peer]) is not None for section in sections)


def relays_of(peer: Values, sections: Sequence[Values]) -> tuple[str, ...]:
    """The names of the relays that a peer uses, in a file without problems. It is not reached along itself."""
    names: list[str] | None = peer.valid.get("relays")
    return tuple(
        section.valid["name"]
        for section in sections
        if peer_of(section, [peer]) is None and (names is None or section.valid["name"] in names)
    )


def addresses_of(peer: Values, sections: Sequence[Values]) -> tuple[PeerAddress, ...]:
    """The addresses of a peer: its own, and those of the relay that it is."""
    of_relay = [written for section in sections if peer_of(section, [peer]) for written in _over_ip(section)]
    return tuple(dict.fromkeys((*peer.valid.get("addresses", ()), *of_relay)))


def advice(relays: Sequence[RelayConfig], peers: Sequence[PeerConfig]) -> Iterator[str]:
    """Yield the warnings."""
    for relay in relays if not peers else ():
        yield f'relay "{relay.name}" has no effect: there is no [[peer]] that it leads to'


def relay_of(section: Values, peers: Sequence[Values], psk: Secret | None, link: Values) -> RelayConfig:
    """The relay of a valid section. It inherits the suites of ``[link]``."""
    suites = tuple(LinkSection.model_construct(**link.valid).suites)
    peer = peer_of(section, peers)
    return RelayConfig(
        settings=PeerSettings(
            name=RELAY_HOST + section.valid["name"],
            public_key=section.valid["public_key"],
            psk=psk,
            link=Link(suites, timers=TIMERS, features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS),
        ),
        addresses=tuple(dict.fromkeys((*([] if peer is None else _over_ip(peer)), *_over_ip(section)))),
        previous_public_key=section.valid.get("previous_public_key"),
        peer=None if peer is None else peer.valid["name"],
    )
