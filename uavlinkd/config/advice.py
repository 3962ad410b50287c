"""Warnings about a configuration: sentences for a person. The daemon runs in spite of them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

from uavlinkd.config.model import Config, EndpointConfig, PeerConfig
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.mavlink.policy.settings import read_settings

_READABLE = (
    "a link through a relay is not confidential: its owner cannot alter the frames, but can read them; write"
    " confidential = true in [link], at one end or both"
)


def advice(config: Config) -> Iterator[str]:
    """Yield the warnings, those about safety first. One that holds for several peers or endpoints comes once."""
    about: dict[str, list[str]] = {}
    for peer in config.peers:
        for warning in _of_peer(peer):
            about.setdefault(warning, []).append(_peer(peer))
    if (fleet := config.fleet) and fleet.relays and fleet.policies and not fleet.link.confidential:
        about.setdefault(_READABLE, []).append("members by certificate")
    for endpoint in config.endpoints:
        for warning in _of_endpoint(endpoint):
            about.setdefault(warning, []).append(_endpoint(endpoint))
    yield from (f"{', '.join(names)}: {warning}" for warning, names in about.items())
    yield from _shared(config)
    vehicles = [_peer(peer) for peer in config.peers if peer.policy.get("role") == "vehicle"]
    if config.relays_frames and len(vehicles) > 1:
        yield (
            f'relay = true, and {", ".join(vehicles)} have the role "vehicle": the answers of a vehicle to its'
            " operator (mission items, parameters, file transfer) are writes to another vehicle, so a captured"
            ' vehicle can change the others through this daemon; link them directly as "swarm-member" instead,'
            " or let each vehicle accept only the operator's system_ids"
        )
    if not config.is_only_relay:
        if not config.endpoints and not (config.relays_frames and len(config.peers) > 1):
            yield "there is no [[endpoint]]: no MAVLink client can connect to this daemon"
        if not config.peers and config.fleet is None:
            yield "there is no [[peer]]: this daemon makes no link"


def _peer(peer: PeerConfig) -> str:
    return f'peer "{peer.name}"'


def _endpoint(endpoint: EndpointConfig) -> str:
    return f'endpoint "{endpoint.name}"'


def _of_peer(peer: PeerConfig) -> Iterator[str]:
    yield from peer.make_policy().warnings
    if peer.relays and not peer.settings.link.confidential:
        yield _READABLE


def _of_endpoint(endpoint: EndpointConfig) -> Iterator[str]:
    for warning in endpoint.make_policy().warnings if endpoint.policy else ():
        # A local client may be any system, unless the file names its systems.
        if "system_ids" in endpoint.policy or not warning.startswith("system_ids"):
            yield warning
    url = endpoint.url
    if not isinstance(url, NetworkUrl) or not url.is_exposed:
        return
    may = (
        "what its policy passes"
        if endpoint.policy
        else "commands (arm, disarm, take-off, flight termination), missions and parameters to every peer, as if this"
        " vehicle had sent them"
    )
    if url.listens:
        yield (
            f"it listens beyond loopback ({url}): any sender that reaches that port can send {may}, and read what the"
            f" peers send; unless that is intended, write {url.kind}:127.0.0.1:{url.address.port}"
        )
    else:
        yield (
            f"it sends beyond this machine ({url}): MAVLink there is neither authentic nor secret; an attacker on"
            f" that path can send {may}"
        )


def _shared(config: Config) -> Iterator[str]:
    """Warn of system ids and PSKs of two peers. A local client may be another component of a system."""
    senders = [(_peer(peer), read_settings(peer.policy, is_local=False).systems) for peer in config.peers]
    senders += [(_endpoint(one), read_settings(one.policy, is_local=True).systems) for one in config.endpoints]
    for (one, systems), (other, others) in combinations(senders, 2):
        if one.startswith("peer") and (both := sorted((systems or frozenset()) & (others or frozenset()))):
            yield (
                f"{one} and {other} may send as the same system {', '.join(map(str, both))}: receivers cannot"
                " distinguish their frames, and one can impersonate the other; unless one carries the other's frames,"
                " allow each system for one of them"
            )
    for a, b in combinations(config.peers, 2):
        if a.settings.psk is not None and a.settings.psk == b.settings.psk:
            yield (
                f"{_peer(a)} and {_peer(b)} have the same PSK: an attacker that captures one of them has it for both;"
                " make one for each pair with `uavlinkd psk`"
            )


def exposure(endpoint: EndpointConfig) -> str:
    """Where an endpoint can be reached from, in two or three words."""
    if endpoint.url.kind is EndpointKind.SERIAL:
        return "wire"
    return "THE NETWORK" if endpoint.url.is_exposed else "this machine"
