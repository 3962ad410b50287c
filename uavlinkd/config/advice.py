"""What a configuration allows and a person should know: sentences, none of which keeps the daemon from running."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from math import ceil

from uavlinkd.system.addresses import IPV4_UDP_BYTES, Address
from uavlinkd.config.model import Endpoint, Peer, Routing
from uavlinkd.core import constants as c
from uavlinkd.core.settings import Link
from uavlinkd.core.wire import initiation_bytes, response_bytes
from uavlinkd.endpoints.url import Kind, NetworkUrl
from uavlinkd.mavlink.policy.settings import read_settings

# UDP payloads that pass in one piece.
IPV6_LEAST_PAYLOAD = 1280 - 40 - 8
"""Every IPv6 path takes it (RFC 8200, section 5)."""
ETHERNET_PAYLOAD = 1500 - 40 - 8
"""Over IPv6; IPv4 has 20 bytes more."""
_SHORT_TAG_BYTES = 8
_HASH_BLOCK_BITS = 512


def advice(
    listen: Sequence[Address],
    endpoints: Sequence[Endpoint],
    peers: Sequence[Peer],
    routing: Routing,
    metrics: Address | None,
) -> Iterator[str]:
    """The sentences, those about safety first."""
    yield from _policies(endpoints, peers)
    yield from _relayed(peers, routing)
    yield from _exposed(endpoints)
    yield from _exposed_metrics(metrics)
    yield from _shared_secrets(peers)
    yield from _lengths(peers)
    yield from _slow(peers)
    yield from _reach(listen, peers)
    if not endpoints:
        yield "there is no [[endpoint]]: no MAVLink program is connected to this daemon"
    if not peers:
        yield "there is no [[peer]]: this daemon is linked to nobody"


def _policies(endpoints: Sequence[Endpoint], peers: Sequence[Peer]) -> Iterator[str]:
    about: dict[str, list[str]] = {}
    for peer in peers:
        for warning in peer.make_policy().warnings:
            about.setdefault(warning, []).append(f'peer "{peer.name}"')
    for endpoint in endpoints:
        for warning in endpoint.make_policy().warnings if endpoint.policy else ():
            # A program on this machine may be any system, unless the file says which.
            if "system_ids" in endpoint.policy or not warning.startswith("system_ids"):
                about.setdefault(warning, []).append(f'endpoint "{endpoint.name}"')
    for warning, whose in about.items():
        yield f"{', '.join(whose)}: {warning}"
    yield from _shared_systems(endpoints, peers)


def _shared_systems(endpoints: Sequence[Endpoint], peers: Sequence[Peer]) -> Iterator[str]:
    """Programs on this machine may be components of one system; systems far from one another are not."""
    speakers: dict[int, list[str]] = {}
    for peer in peers:
        for system in read_settings(peer.policy, is_local=False).systems or ():
            speakers.setdefault(system, []).append(f'peer "{peer.name}"')
    for endpoint in endpoints:
        for system in read_settings(endpoint.policy, is_local=True).systems or ():
            if system in speakers:
                speakers[system].append(f'endpoint "{endpoint.name}"')
    shared: dict[tuple[str, ...], list[int]] = {}
    for system, names in sorted(speakers.items()):
        if len(names) > 1:
            shared.setdefault(tuple(names), []).append(system)
    for speaking, systems in shared.items():
        who = f"{', '.join(speaking[:-1])} and {speaking[-1]}"
        yield (
            f"{who} may speak as the same {_systems(systems)}: a peer is kept from speaking as others, and here they"
            " are no others, so nobody can tell who it was; unless one carries the other's frames, give each system"
            " to one of them"
        )


def _relayed(peers: Sequence[Peer], routing: Routing) -> Iterator[str]:
    vehicles = [f'"{peer.name}"' for peer in peers if peer.policy.get("role") == "vehicle"]
    if routing.relay and len(vehicles) > 1:
        yield (
            f'relay = true, and peers {", ".join(vehicles)} have the role "vehicle": what a vehicle answers to its'
            " operator (mission items, parameters, file transfer) is a write to another vehicle, so one that is"
            ' captured can reach the others through here; link them with each other as "swarm-member" instead'
        )


def _systems(systems: Sequence[int]) -> str:
    return f"system {systems[0]}" if len(systems) == 1 else f"systems {', '.join(map(str, systems))}"


def _exposed(endpoints: Sequence[Endpoint]) -> Iterator[str]:
    for endpoint in endpoints:
        url = endpoint.url
        if not isinstance(url, NetworkUrl) or not url.is_exposed:
            continue
        may = "with what its policy lets through" if endpoint.policy else "with any message, as any system"
        if url.kind is Kind.TCP:
            yield (
                f'endpoint "{endpoint.name}" connects beyond this machine ({url}): between there and here MAVLink is'
                f" neither authentic nor secret, and who is on the way can speak to every peer {may}"
            )
        elif url.listens and endpoint.policy:
            yield (
                f'endpoint "{endpoint.name}" listens beyond loopback ({url}): a stranger who reaches that port can'
                " say and hear what its policy lets through; unless that is meant, write"
                f" {url.kind}:127.0.0.1:{url.address.port}"
            )
        elif url.listens:
            yield (
                f'endpoint "{endpoint.name}" listens beyond loopback ({url}): a stranger who reaches that port can'
                " send commands (arm, disarm, take-off, flight termination), missions and parameters, which go to"
                " every peer as if this vehicle had sent them, and can read what the peers send;"
                f" unless that is meant, write {url.kind}:127.0.0.1:{url.address.port}"
            )
        else:
            yield (
                f'endpoint "{endpoint.name}" sends beyond this machine ({url}): between there and here MAVLink is'
                f" neither authentic nor secret, and who forges that address can speak to every peer {may}"
            )


def _exposed_metrics(metrics: Address | None) -> Iterator[str]:
    if metrics is not None and not metrics.is_loopback:
        yield (
            f"metrics.listen is beyond loopback ({metrics}): whoever reaches that port reads who is linked with whom,"
            " when and how much they say, unencrypted; let only Prometheus through the firewall, or write"
            f' listen = "127.0.0.1:{metrics.port}"'
        )


def _shared_secrets(peers: Sequence[Peer]) -> Iterator[str]:
    for a, b in combinations(peers, 2):
        if a.settings.psk is not None and a.settings.psk == b.settings.psk:
            yield (
                f'peers "{a.name}" and "{b.name}" have the same PSK: who captures one of them has it for both;'
                " make one for each pair with `uavlinkd psk`"
            )


def _lengths(peers: Sequence[Peer]) -> Iterator[str]:
    short = _whose(peers, lambda link: not link.confidential and link.tag_bytes <= _SHORT_TAG_BYTES)
    if short:
        yield (
            f"tags of 64 bits with {short}: each forged envelope has one chance in 2^64; the bytes saved are for"
            " slow radios, elsewhere write tag_bits = 128"
        )
    long_keys = _whose(peers, lambda link: not link.confidential and link.mac_key_bits > _HASH_BLOCK_BITS)
    if long_keys:
        yield (
            f"MAC keys over 512 bits with {long_keys}: HMAC hashes a key longer than its block first (RFC 2104),"
            " so nothing is gained over mac_key_bits = 512"
        )
    unused = _whose(peers, lambda link: link.confidential and (link.tag_bytes, link.mac_key_bits) != (16, 256))
    if unused:
        yield (
            f"tag_bits and mac_key_bits mean nothing with {unused}: a confidential link has the tag and the key of"
            " ChaCha20-Poly1305, 128 and 256 bits"
        )
    split = _whose(peers, lambda link: link.max_envelope > ETHERNET_PAYLOAD)
    if split:
        yield (
            f"envelopes over {ETHERNET_PAYLOAD:,} bytes with {split}: most networks split them, and one lost part"
            " loses all; unless the path is known to take them, write"
            f" max_envelope_bytes = {c.DEFAULT_ENVELOPE_LIMIT}"
        )
    for suite in dict.fromkeys(suite for peer in peers for suite in peer.settings.link.suites):
        size = initiation_bytes(suite)
        if size <= IPV6_LEAST_PAYLOAD:
            continue
        with_whom = _whose(peers, lambda link, suite=suite: suite in link.suites)  # type: ignore[misc]
        start = f"a handshake with {suite.name} starts with a datagram of {size:,} bytes ({with_whom}): "
        if size > ETHERNET_PAYLOAD:
            yield start + "more than an MTU of 1,500 takes, so every path must carry fragments; many do not"
        else:
            yield start + "Ethernet takes it, a path with IPv6's least MTU of 1,280 (some tunnels) does not"


def _slow(peers: Sequence[Peer]) -> Iterator[str]:
    """What a budget cannot carry in time."""
    for peer in peers:
        link, budget = peer.settings.link, peer.egress.budget_bits_s
        if not budget:
            continue
        size = max(initiation_bytes(link.suites[0]), response_bytes(link.suites[0])) + IPV4_UDP_BYTES
        if size * 8 / budget > link.timers.retry_max_s:
            yield (
                f"a handshake with {link.suites[0].name} takes {size * 8 / budget:.1f} s at {budget:,} bits/s"
                f' with "{peer.name}", and after {link.timers.retry_max_s:g} s the next is tried: write'
                f" retry_max_s = {ceil(size * 16 / budget)}"
            )


def _reach(listen: Sequence[Address], peers: Sequence[Peer]) -> Iterator[str]:
    for peer in peers:
        # A name may have addresses of both families.
        numeric = [address for address in peer.addresses if address.ip is not None]
        if not listen or not numeric or len(numeric) < len(peer.addresses):
            continue
        if not any(own.family == address.family for own in listen for address in numeric):
            family = "[::]" if numeric[0].ip is not None and numeric[0].ip.version == 6 else "0.0.0.0"
            yield (f'peer "{peer.name}" has no address of a kind that listen has: add "{family}:{listen[0].port}"')
        elif all(own.is_loopback for own in listen) and not any(address.is_loopback for address in numeric):
            yield f'peer "{peer.name}" is on the network, listen names loopback alone: neither reaches the other'
    for a, b in combinations(peers, 2):
        if both := set(a.addresses) & set(b.addresses):
            yield f'peers "{a.name}" and "{b.name}" have the address {min(both)} in common: only one can be there'


def _whose(peers: Sequence[Peer], concerns: Callable[[Link], bool]) -> str:
    """The names of the peers whose link is concerned; empty for none."""
    found = [peer.name for peer in peers if concerns(peer.settings.link)]
    if len(found) > 1 and len(found) == len(peers):
        return "every peer"
    return ", ".join(found)


def exposure(endpoint: Endpoint) -> str:
    """Who can reach an endpoint, in two or three words."""
    if endpoint.url.kind is Kind.SERIAL:
        return "wire"
    return "THE NETWORK" if endpoint.url.is_exposed else "this machine"
