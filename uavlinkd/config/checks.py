"""Rules between the values of a configuration. Each yields the place of a key, what is wrong there and what to do.

A rule uses the valid values and ignores the others.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

from uavlinkd.config import fleet_rules, key_rules, network_rules, relay_rules
from uavlinkd.config.build import policy_data, policy_problems
from uavlinkd.config.file import File, Found, over_ip, unique, with_same_key
from uavlinkd.config.section import Values
from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl
from uavlinkd.system.addresses import Address, overlaps


def check(file: File) -> Found:
    for kind in ("endpoint", "network", "fleet_role"):
        yield from unique(file[kind], "name")
    yield from unique(file.used_relays, "name")
    for kind in ("peer", "member", "relay", "contact"):
        yield from unique(file[kind], "public_key")
    for key in ("interface", "address"):
        yield from unique(file["network"], key)
    yield from unique(
        [one for one in file["endpoint"] if isinstance(url := one.get("url"), NetworkUrl) and not url.listens], "url"
    )
    yield from key_rules.check(file)
    yield from relay_rules.check(file)
    yield from _who_initiates(file)
    yield from _ports(file)
    yield from _devices(file)
    yield from fleet_rules.check(file)
    yield from network_rules.check(file)
    for kind in ("endpoint", "peer"):
        for section in file[kind]:
            yield from policy_problems(section, policy_data(section), is_local=kind == "endpoint")


def _who_initiates(file: File) -> Found:
    """One of the two ends can initiate: an address, a relay, or an address of this daemon is known."""
    for peer in file["peer"]:
        has_relay = bool(file.used_relays) and peer.get("relays") != [] and "relays" not in peer.invalid
        can_call = has_relay or not peer.lacks("addresses") or with_same_key(peer, file.used_relays)
        if not can_call and file.top.lacks("listen"):
            yield (
                peer.at("addresses"),
                "is empty, and so is listen: neither end could initiate; write the peer's address here,"
                ' or listen = ["0.0.0.0:5790"] at the top so that the peer can initiate, or a [[relay]] that both'
                " ends use",
            )


class _Port(NamedTuple):
    """An address where this daemon listens or to which it sends, with its place in the file."""

    place: str
    is_udp: bool
    address: Address


def _ports(file: File) -> Found:
    """Each port has one listener. The daemon does not send to itself: frames would loop."""
    listening, sending = list(_listening(file)), list(_sending(file))
    for one, other in combinations(listening, 2):
        if one.is_udp == other.is_udp and overlaps(one.address, other.address):
            yield other.place, f"has the port where {one.place} listens too, {one.address}: write another"
    for sender in sending:
        for listener in listening:
            if sender.is_udp == listener.is_udp and _reaches(sender.address, listener.address):
                text = f"names {sender.address}, where this daemon listens ({listener.place}), so frames would loop"
                yield sender.place, f"{text}: write the address of the other end"


def _listening(file: File) -> Iterator[_Port]:
    for address in file.top.get("listen"):
        yield _Port("listen", True, address)
    for section in file["endpoint"]:
        if isinstance(url := section.get("url"), NetworkUrl) and url.listens:
            yield _Port(section.at("url"), url.kind is EndpointKind.UDPIN, url.address)
    if https := file.one("relay_server").get("https"):
        yield _Port("relay_server.https", False, https.listen)


def _sending(file: File) -> Iterator[_Port]:
    for section in (*file["peer"], *file["relay"], *file["contact"]):
        for written in over_ip(section):
            yield _Port(section.at("addresses"), not written.address.resource, written.address)
    for section in file["endpoint"]:
        if isinstance(url := section.get("url"), NetworkUrl) and not url.listens:
            yield _Port(section.at("url"), url.kind is EndpointKind.UDPOUT, url.address)


def _reaches(target: Address, listening: Address) -> bool:
    """Whether a datagram to ``target`` arrives at this machine's ``listening``, as far as the text shows."""
    if target.port != listening.port or target.family != listening.family:
        return False
    return target.ip == listening.ip or (listening.is_wildcard and target.is_loopback)


def _devices(file: File) -> Found:
    """A device has one user: a network or an endpoint."""
    users: dict[str, Values] = {}
    for section in (*file["endpoint"], *file["network"]):
        key = "url" if section.kind == "endpoint" else "serial"
        if isinstance(line := section.get(key), SerialUrl):
            other = users.setdefault(os.path.realpath(line.device), section)
            if other is not section:
                yield section.at(key), f"is the device of {other.at()} too, and only one can open it: write another"
