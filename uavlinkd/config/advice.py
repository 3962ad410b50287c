"""Warnings about a configuration: sentences for a person. The daemon runs in spite of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from uavlinkd.authority.certificates import parse_bulletin, parse_certificate
from uavlinkd.config.model import Config, EndpointConfig, FleetConfig, PeerAddress, PeerConfig
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.mavlink.policy.settings import read_settings
from uavlinkd.system.addresses import Address

_READABLE = (
    "a link through a relay is not confidential: its owner cannot alter the frames, but can read them; write"
    " confidential = true in [link], at one end or both"
)


def advice(config: Config) -> Iterator[str]:
    """Yield the warnings, those about safety first."""
    endpoints, peers = config.endpoints, config.peers
    every = [f'peer "{peer.name}"' for peer in peers]
    about: dict[str, list[str]] = {}
    for peer in peers:
        for warning in _of_peer(peer):
            about.setdefault(warning, []).append(f'peer "{peer.name}"')
    if config.fleet is not None:
        yield from _revoked(config.fleet)
        if config.fleet.relays and config.fleet.policies and not config.fleet.link.confidential:
            about.setdefault(_READABLE, []).append("members by certificate")
    for endpoint in endpoints:
        for warning in _of_endpoint(endpoint):
            about.setdefault(warning, []).append(f'endpoint "{endpoint.name}"')
    for warning, names in about.items():
        yield f"{'every peer' if names == every and len(every) > 1 else ', '.join(names)}: {warning}"
    yield from _shared_systems(endpoints, peers)
    yield from _relayed(peers, config.relays_frames)
    yield from _reach(() if config.has_ip_networks else config.listen, peers)
    yield from _shared(peers)
    if config.is_only_relay:
        return
    if not endpoints and not (config.relays_frames and len(peers) > 1):
        yield "there is no [[endpoint]]: no MAVLink client can connect to this daemon"
    if not peers and config.fleet is None:
        yield "there is no [[peer]]: this daemon makes no link"


def _of_peer(peer: PeerConfig) -> Iterator[str]:
    yield from peer.make_policy().warnings
    if peer.relays and not peer.settings.link.confidential:
        yield _READABLE


def _revoked(fleet: FleetConfig) -> Iterator[str]:
    """Warn of the certificates that the bulletin of the file revokes."""
    bulletin = parse_bulletin(fleet.bulletin)
    assert bulletin is not None  # it was checked
    if bulletin.refuses(fleet.own.certificate.serial):
        yield (
            f"the bulletin of this file revokes this daemon's own certificate ({fleet.own.certificate.name}, serial"
            f" {fleet.own.certificate.serial}): other members refuse it; run `uavlinkd enroll` again, with a new key"
        )
    for contact in fleet.contacts:
        if bulletin.refuses(parse_certificate(contact.certificate).serial):
            yield f'the bulletin of this file revokes contact "{contact.name}": delete its [[contact]]'


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


def _shared_systems(endpoints: Sequence[EndpointConfig], peers: Sequence[PeerConfig]) -> Iterator[str]:
    """Warn of systems that several peers may send as. Local clients may be components of one system."""
    senders: dict[int, list[str]] = {}
    for peer in peers:
        for system in read_settings(peer.policy, is_local=False).systems or ():
            senders.setdefault(system, []).append(f'peer "{peer.name}"')
    for endpoint in endpoints:
        for system in read_settings(endpoint.policy, is_local=True).systems or ():
            if system in senders:
                senders[system].append(f'endpoint "{endpoint.name}"')
    shared: dict[tuple[str, ...], list[int]] = {}
    for system, names in sorted(senders.items()):
        if len(names) > 1:
            shared.setdefault(tuple(names), []).append(system)
    for several, systems in shared.items():
        which = f"system{'s' if len(systems) > 1 else ''} {', '.join(map(str, systems))}"
        yield (
            f"{', '.join(several[:-1])} and {several[-1]} may send as the same {which}: receivers cannot distinguish"
            " their frames, and one can impersonate the other; unless one carries the other's frames, allow each"
            " system for one of them"
        )


def _relayed(peers: Sequence[PeerConfig], relays_frames: bool) -> Iterator[str]:
    vehicles = [f'"{peer.name}"' for peer in peers if peer.policy.get("role") == "vehicle"]
    if relays_frames and len(vehicles) > 1:
        yield (
            f'relay = true, and peers {", ".join(vehicles)} have the role "vehicle": the answers of a vehicle to its'
            " operator (mission items, parameters, file transfer) are writes to another vehicle, so a captured"
            ' vehicle can change the others through this daemon; link them directly as "swarm-member" instead,'
            " or let each vehicle accept only the operator's system_ids"
        )


def _reach(listen: Sequence[Address], peers: Sequence[PeerConfig]) -> Iterator[str]:
    for peer in peers:
        # A name may have addresses of both families.
        numeric = [written.address for written in peer.addresses if written.address.ip is not None]
        if not listen or not numeric or len(numeric) < len(peer.addresses):
            continue
        if not any(own.family == address.family for own in listen for address in numeric):
            yield (
                f'peer "{peer.name}" has no address of an IP version that listen has:'
                f" add {listen[0].wildcard(of_other_version=True)} to listen"
            )
        elif all(own.is_loopback for own in listen) and not any(address.is_loopback for address in numeric):
            yield f'peer "{peer.name}" is on the network, but listen names only loopback: neither reaches the other'


def _shared(peers: Sequence[PeerConfig]) -> Iterator[str]:
    """Warn of addresses and PSKs of two peers."""
    for a, b in combinations(peers, 2):
        both = [one.address for one in a.addresses for other in b.addresses if _clash(one, other)]
        if both:
            yield f'peers "{a.name}" and "{b.name}" share the address {min(both)}: only one peer can use it'
        if a.settings.psk is not None and a.settings.psk == b.settings.psk:
            yield (
                f'peers "{a.name}" and "{b.name}" have the same PSK: an attacker that captures one of them has it'
                " for both; make one for each pair with `uavlinkd psk`"
            )


def _clash(a: PeerAddress, b: PeerAddress) -> bool:
    """Whether both are one address on one network."""
    return a.address == b.address and (a.network == b.network or not (a.network and b.network))


def exposure(endpoint: EndpointConfig) -> str:
    """Where an endpoint can be reached from, in two or three words."""
    if endpoint.url.kind is EndpointKind.SERIAL:
        return "wire"
    return "THE NETWORK" if endpoint.url.is_exposed else "this machine"
