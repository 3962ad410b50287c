"""Rules about relays: ``[[member]]`` of a relay, ``[[relay]]``, and which peers use which relays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from uavlinkd.config.model import PeerAddress
from uavlinkd.config.problems import Found, Sections, Values, unique

MOST_MEMBERS: Final = 4000  # each has up to three sessions, of 65,535 indices
MOST: Final = 3  # Relays of one daemon. A peer has room for the paths along so many.


def members(file: Sections) -> Found:
    """Members can reach the relay. One may also be a peer, with the same key: then one session serves both."""
    by_name = {peer.get("name"): peer for peer in file.peers}
    for section in file.members:
        name, peer = section.get("name"), peer_of(section, file.peers)
        if peer is not None:
            yield from _of_peer(section, peer)
        if "public_key" in section.valid and name is not None and by_name.get(name, peer) is not peer:
            text = f"is the name of {by_name[name].at()} too, which has another key: write another name"
            yield section.at("name"), text
    if len(file.members) > MOST_MEMBERS:
        yield "member", f"has more than {MOST_MEMBERS:,} sections: run several relays, each on a port of its own"
    if file.is_relay and file.top.lacks("listen"):
        yield "listen", 'is empty, so no member could reach this relay: write listen = ["0.0.0.0:5790", "[::]:5790"]'
    elif file.relay_server.valid and not file.is_relay:
        yield (
            "relay_server",
            "has no effect, because the file has no [[member]]: write one with name and public_key for each daemon"
            " that may use this relay",
        )
    if "member_bits_s" in file.relay_server.valid and file.is_relay and not file.has_fleet:
        text = "is for members by certificate, but the file has no [fleet]: write bits_s in each [[member]]"
        yield "relay_server.member_bits_s", text


def _of_peer(section: Values, peer: Values) -> Found:
    """A member or relay that is a peer too leaves to the peer what belongs to their one session."""
    if "psk_file" in section.valid:
        yield (
            section.at("psk_file"),
            f"has no effect, because {peer.at()} has the same public_key: write it there only",
        )


def relays(file: Sections) -> Found:
    """Each relay has an address, and a key of its own or a peer's. Each relay that a peer names is in the file."""
    if len(file.used_relays) > MOST:
        count = f"{len(file.used_relays)} sections, with each [[contact]] that relays"
        yield "relay", f"has {count}: write at most {MOST}, the most reliable ones"
    yield from unique(file.used_relays, "name", "the name of {other} too: write another")
    by_member = {member.get("public_key"): member for member in file.members}
    for number, section in enumerate(file.relays):
        key, peer = section.get("public_key"), peer_of(section, file.peers)
        if key is not None and key in by_member:
            yield (
                section.at("public_key"),
                f"is the key of {by_member[key].at()} too, and two daemons cannot be relays of each other:"
                " run the relay with a key of its own (`uavlinkd keygen`)",
            )
        if peer is not None:
            yield from _of_peer(section, peer)
        yield from _addresses(section, peer, file.relays[:number])
    for section in (*file.peers, *file.contacts):
        is_relay = section in file.used_relays
        if not is_relay and any(written.address.resource for written in section.get("addresses", ())):
            yield section.at("addresses"), "has the URL of a relay, and this is none: write it in a [[relay]]"
    known = {section.get("name"): section for section in file.used_relays}
    names = ", ".join(f'"{name}"' for name in sorted(name for name in known if name is not None))
    for peer in file.peers if len(known) == len(file.used_relays) and None not in known else ():
        for name in peer.get("relays") or ():
            if name not in known:
                remedy = f"write one of {names}" if names else "add a [[relay]] of that name"
                yield peer.at("relays"), f"names a relay that this file does not have: {remedy}"
            elif peer_of(known[name], [peer]) is not None:
                yield peer.at("relays"), f"names {name}, which has this peer's key: leave it out"


def _addresses(section: Values, peer: Values | None, others: Sequence[Values]) -> Found:
    """At least one over IP. One process answers at an address, with one key."""
    place = section.at("addresses")
    has_peers = peer is not None and ("addresses" in peer.invalid or bool(over_ip(peer)))
    if section.lacks("addresses") and not has_peers:
        yield place, 'is empty, and a relay never initiates: write its address, such as ["relay.example.org:5790"]'
    if any(written.is_serial for written in section.get("addresses", ())):
        yield place, "names a serial network, but a relay is reached over IP: write its IP address or name"
    for other in others:
        shared = [written for written in over_ip(section) if written in over_ip(other)]
        if shared and section.get("public_key") != other.get("public_key"):
            text = f"has {shared[0]}, an address of {other.at()} too, which has another key: write the address of"
            yield place, f"{text} this relay"


def over_ip(section: Values) -> list[PeerAddress]:
    return [written for written in section.get("addresses", ()) if not written.is_serial]


def peer_of(section: Values, peers: Sequence[Values]) -> Values | None:
    """The peer with the key of a relay or member."""
    key = section.get("public_key")
    return next((peer for peer in peers if key is not None and peer.get("public_key") == key), None)


def needs_no_address(peer: Values, sections: Sequence[Values]) -> bool:
    """Whether a peer uses a relay of the file, or is one, which has an address."""
    uses_relays = bool(sections) and peer.get("relays") != [] and "relays" not in peer.invalid
    return uses_relays or any(peer_of(section, [peer]) is not None for section in sections)
