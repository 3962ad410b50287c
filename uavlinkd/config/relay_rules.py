"""Rules about relays: ``[[member]]`` of a relay, ``[[relay]]``, and which peers use which relays."""

from __future__ import annotations

from typing import Final

from uavlinkd.config.file import File, Found, over_ip, unique, with_same_key

MOST_MEMBERS: Final = 4000  # each has up to three sessions, of 65,535 indices
MOST: Final = 3  # Relays of one daemon. A peer has room for the paths along so many.


def check(file: File) -> Found:
    yield from _members(file)
    yield from _relays(file)
    yield from _uses(file)


def _members(file: File) -> Found:
    """Members can reach the relay. One may also be a peer, with the same key: then one session serves both."""
    peers = file["peer"]
    yield from unique([*peers, *(one for one in file["member"] if with_same_key(one, peers) is None)], "name")
    if len(file["member"]) > MOST_MEMBERS:
        yield "member", f"has more than {MOST_MEMBERS:,} sections: run several relays, each on a port of its own"
    if file.is_relay and file.top.lacks("listen"):
        yield "listen", 'is empty, so no member could reach this relay: write listen = ["0.0.0.0:5790", "[::]:5790"]'
    elif file["relay_server"] and not file.is_relay:
        text = "write one with name and public_key for each daemon that may use this relay"
        yield "relay_server", f"has no effect, because the file has no [[member]]: {text}"


def _relays(file: File) -> Found:
    """Each relay has a name of its own, an address over IP, and a key that is not a member's."""
    yield from unique(file.used_relays, "name")
    if len(file.used_relays) > MOST:
        count = f"{len(file.used_relays)} sections, with each [[contact]] that relays"
        yield "relay", f"has {count}: write at most {MOST}, the most reliable ones"
    for section in file["relay"]:
        if (member := with_same_key(section, file["member"])) is not None:
            text = f"is the key of {member.at()} too, and two daemons cannot be relays of each other"
            yield section.at("public_key"), f"{text}: run the relay with a key of its own (`uavlinkd keygen`)"
    for section in file.used_relays:
        peer = with_same_key(section, file["peer"])
        unknown = "addresses" in section.invalid or (peer is not None and "addresses" in peer.invalid)
        if not over_ip(section) and not (peer is not None and over_ip(peer)) and not unknown:
            text = (
                'has no address over IP, and a relay never initiates: write one, such as ["relay.example.org:5790"]'
            )
            yield section.at("addresses"), text


def _uses(file: File) -> Found:
    """Each relay that a peer names is in the file, and is not that peer."""
    used = file.used_relays
    for section in (*file["peer"], *file["contact"]):
        if section not in used and any(written.address.resource for written in section.get("addresses")):
            yield section.at("addresses"), "has the URL of a relay, and this is none: write it in a [[relay]]"
    for peer in file["peer"]:
        may_name = {relay.get("name") for relay in used if with_same_key(relay, [peer]) is None}
        if not may_name.issuperset(peer.get("relays") or ()) and None not in may_name:
            names = ", ".join(f'"{name}"' for name in sorted(may_name)) or "none"
            text = f"names a relay that this file does not have, or this peer itself: the relays are {names}"
            yield peer.at("relays"), text
