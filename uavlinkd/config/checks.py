"""Rules between the values of a configuration. Each yields the place of a key, what is wrong there and what to do.

A rule uses the valid values and ignores the others.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from ipaddress import ip_address, ip_network
from itertools import combinations
from typing import Final

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config import fleet_rules
from uavlinkd.config.build import policy_data, policy_problems
from uavlinkd.config.file import File, Found, over_ip, role_of, unique, with_same_key
from uavlinkd.config.keys import looks_private
from uavlinkd.config.members import MOST_MEMBERS
from uavlinkd.config.model import SERIAL, PeerAddress
from uavlinkd.config.section import Values
from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings
from uavlinkd.protocol.crypto import x25519_public_key
from uavlinkd.system.addresses import Address, overlaps

_UNIQUE: Final = (
    *((kind, "name") for kind in ("endpoint", "network", "fleet_role")),
    *((kind, "public_key") for kind in ("peer", "member", "relay", "contact", "station")),
    ("station", "address"),
    *(("network", key) for key in ("interface", "address")),
)
_EXITS: Final = ("interface", "address", "serial")
_MOST_RELAYS: Final = 3  # Relays of one daemon. A peer has room for the paths along so many.


def check(file: File) -> Found:
    for kind, key in _UNIQUE:
        yield from unique(file[kind], key)
    of_others = (_keys, _members, _relays, _uses, fleet_rules.check, _networks, _who_initiates)
    for rule in (*of_others, _ports, _devices, _stations, _signing):
        yield from rule(file)
    for kind in ("endpoint", "peer", "station"):
        for section in file[kind]:
            yield from policy_problems(section, policy_data(section), is_local=kind == "endpoint")


def _who_initiates(file: File) -> Found:
    """One of the two ends can initiate: an address, a relay, or an address of this daemon is known."""
    for peer in file["peer"] if file.top.lacks("listen") else ():
        has_relay = bool(file.used_relays) and peer.get("relays") != [] and "relays" not in peer.invalid
        if peer.lacks("addresses") and not has_relay and with_same_key(peer, file.used_relays) is None:
            yield (
                peer.at("addresses"),
                "is empty, and so is listen: neither end could initiate; write the peer's address here,"
                ' or listen = ["0.0.0.0:5790"] at the top so that the peer can initiate, or a [[relay]] that both'
                " ends use",
            )


def _ports(file: File) -> Found:
    """Each port has one listener. Endpoints do not send to this daemon, nor several to one client."""
    ends = [("listen", NetworkUrl(EndpointKind.UDPIN, address)) for address in file.top.get("listen")]
    ends += [(one.at("url"), url) for one in file["endpoint"] if isinstance(url := one.get("url"), NetworkUrl)]
    if file["station"] and (listen := file.one("stations").get("listen")) is not None:
        ends.append(("stations.listen", NetworkUrl(EndpointKind.UDPIN, listen)))
    if https := file.one("relay_server").get("https"):
        ends.append(("relay_server.https", NetworkUrl(EndpointKind.TCPIN, https.listen)))
    for (other, one), (place, two) in combinations(ends, 2):
        if one.is_udp == two.is_udp and _clash(one, two):
            text = "two cannot listen there, and frames would loop or arrive twice"
            yield place, f"has the port of {other} too, {one.address}: {text}; write another"


def _clash(one: NetworkUrl, two: NetworkUrl) -> bool:
    if one.listens is two.listens:
        return overlaps(one.address, two.address) if one.listens else one == two
    target, listening = (two.address, one.address) if one.listens else (one.address, two.address)
    if (target.port, target.family) != (listening.port, listening.family):
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


def _stations(file: File) -> Found:
    """Each station has an inner address and system ids of its own, and is one who commands or watches."""
    stations, keys = file["station"], file.one("stations")
    if not stations:
        return
    yield from unique([*file["endpoint"], *stations], "name")
    if not file["stations"]:
        yield "stations", 'is missing: write [stations] with private_key_file = "stations.key"'
    if (secret := keys.get("private_key_file")) is not None and secret == file.top.get("private_key_file"):
        text = "is the key of the daemon for other daemons too, and a key is for one protocol: make another one with"
        yield "stations.private_key_file", f"{text} `uavlinkd keygen`"
    network = ip_network(keys.get("network")) if "network" not in keys.invalid else None
    local = {system: one for one in file["endpoint"] for system in _numbers(one)}
    for station in stations:
        if network is not None and "address" in station.valid:
            address = ip_address(station.get("address"))
            if address not in network or address in (network[0], network[1], network[-1]):
                first, last = network[2], network[-2]
                text = f"is not for a station of {network}, or the daemon's own: write one from {first} to {last}"
                yield station.at("address"), text
        if station.get("role") == "vehicle":
            text = "is not the role of a ground station: write operator, or observer for one that only watches"
            yield station.at("role"), text
        ids = _numbers(station)
        for system in ids & set(local):
            text = (
                f"has the system id of {local[system].at()} too, so one could speak as the other: write another one"
            )
            yield station.at("system_ids"), text
        # A vehicle's own station commands this vehicle. At others, the certificate of this member decides.
        if role_of(fleet := file.one("fleet")) is MemberRole.OPERATOR:
            own = fleet.get("certificate").certificate
            if any(system not in own.systems for system in ids):
                had = f"{own.system_ids[0]} to {own.system_ids[1]}"
                text = f"has an id that vehicles refuse from this member, whose certificate has {had}: write one that"
                remedy = f"`uavlinkd fleet enroll --here {own.name} --replace --id A-B` gives it more"
                yield station.at("system_ids"), f"{text} no [[endpoint]] has; {remedy}"


def _signing(file: File) -> Found:
    """A signing key is no other key of the file. Two endpoints with the same one have two link ids."""
    of_sections = ((file.top, "private_key_file"), (file.one("stations"), "private_key_file"))
    others = [section.get(key) for section, key in (*of_sections, *((peer, "psk_file") for peer in file["peer"]))]
    before: list[Values] = []
    for endpoint in file["endpoint"]:
        if (secret := endpoint.get("signing_key_file")) is None:
            continue
        if secret in others:
            text = "is another key of this file too, and the autopilot would get it: make one of its own with"
            yield endpoint.at("signing_key_file"), f"{text} `uavlinkd signing setup`"
        for other in before:
            is_shared = other.get("signing_key_file") == secret
            if is_shared and other.get("signing_link_id") == endpoint.get("signing_link_id"):
                text = f"is in use by {other.at()} with the same key: write another one, 16 to 255"
                yield endpoint.at("signing_link_id"), text
        before.append(endpoint)


def _numbers(section: Values) -> set[int]:
    """The system ids that a section names."""
    with suppress(PolicyError):  # which is reported by itself
        return set(read_settings(policy_data(section), is_local=True).systems or ())
    return set()


def _keys(file: File) -> Found:
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
    if len(file.used_relays) > _MOST_RELAYS:
        count = f"{len(file.used_relays)} sections, with each [[contact]] that relays"
        yield "relay", f"has {count}: write at most {_MOST_RELAYS}, the most reliable ones"
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


def _networks(file: File) -> Found:
    """Each network is one exit of its own, and each address of a peer names one that can have it."""
    for section in file["network"]:
        if not section.invalid.intersection(_EXITS) and sum(key in section.valid for key in _EXITS) != 1:
            yield (
                section.at(),
                'has no exit, or several: write one of interface = "wwan0", address = "10.0.0.5" with an address of'
                ' this machine, or serial = "/dev/ttyUSB0:57600"',
            )
        elif "serial" in section.valid and section.get("metered"):
            yield section.at("metered"), "is for networks that cost money, and this is a serial line: leave it out"
    if any(key in section.valid for section in file["network"] for key in ("interface", "address")):
        yield from _listen(file.top)
    if not any(section.invalid for section in file["network"]):
        yield from _addresses(file, (*file["peer"], *file["relay"], *file["contact"]))


def _listen(top: Values) -> Found:
    """With networks, ``listen`` has only the ports of their sockets, at most one of each IP version."""
    listen: list[Address] = top.get("listen")
    if len({address.family for address in listen}) < len(listen) or not all(one.is_wildcard for one in listen):
        yield (
            "listen",
            "has more than a port for each IP version, but the networks of this file decide where the daemon listens:"
            f" write {listen[0].wildcard()} for this port on each network",
        )


def _addresses(file: File, peers: Iterable[Values]) -> Found:
    """A serial network has one peer at its other end, which names it without an address. Others need addresses."""
    serial = [section for section in file["network"] if "serial" in section.valid]
    lines = {section.get("name") for section in serial}
    others = {section.get("name") for section in file["network"]} - lines
    for peer in peers:
        for written in peer.get("addresses"):
            if written.network and written.network not in (lines if written.is_serial else others):
                known = f"{_listed(others, 'addresses')}, {_listed(lines, 'a serial line')}"
                forms = '{ address = "10.13.0.2:5790", network = "mesh" }, or { network = "sik" } for a serial one'
                yield peer.at("addresses"), f'names the network "{written.network}", but {known}: write {forms}'
    for section in serial if not any("addresses" in peer.invalid for peer in peers) else ():
        name = section.get("name")
        users = [peer for peer in peers if PeerAddress(SERIAL, name) in peer.get("addresses")]
        if len(users) != 1:
            problem = f"is named by {users[0].at()} and {users[1].at()}" if users else "has no peer at its other end"
            text = (
                f'{problem}: write addresses = [{{ network = "{name}" }}] in the [[peer]] or [[contact]] of that end'
            )
            yield section.at("serial"), text


def _listed(names: Iterable[str], what: str) -> str:
    return f"the networks with {what} are {', '.join(sorted(names)) or 'none'}"
