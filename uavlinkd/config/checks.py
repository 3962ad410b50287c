"""Rules between the values of a configuration. Each yields the place of a key, what is wrong there and what to do.

A rule uses the valid values and ignores the others.
"""

from __future__ import annotations

import os
from itertools import combinations
from typing import Final

from uavlinkd.config import fleet_rules, key_rules, network_rules, relay_rules
from uavlinkd.config.build import policy_data, policy_problems
from uavlinkd.config.file import File, Found, unique, with_same_key
from uavlinkd.config.section import Values
from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl
from uavlinkd.system.addresses import overlaps

_UNIQUE: Final = (
    *((kind, "name") for kind in ("endpoint", "network", "fleet_role")),
    *((kind, "public_key") for kind in ("peer", "member", "relay", "contact")),
    *(("network", key) for key in ("interface", "address")),
)


def check(file: File) -> Found:
    for kind, key in _UNIQUE:
        yield from unique(file[kind], key)
    for rule in (key_rules, relay_rules, fleet_rules, network_rules):
        yield from rule.check(file)
    yield from _who_initiates(file)
    yield from _ports(file)
    yield from _devices(file)
    for kind in ("endpoint", "peer"):
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
