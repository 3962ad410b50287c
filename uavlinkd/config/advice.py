"""Warnings about a configuration: sentences for a person. The daemon runs in spite of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

from uavlinkd.config.keys import encode_key, looks_private
from uavlinkd.config.model import Config, EndpointConfig, PeerConfig

EXAMPLE_KEYS: Final = frozenset(
    {
        "Ya1BcyCMNCoxhVU/dI5z9wlfOD9PHricYw/gaSC3swU=",
        "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE=",
        "tJLyzZrt6Sa42Db32IyrBDlKIWCLqF0Ru8srHbdIT3A=",
        "Is+OSCKTa6Id2wymhOZXYuDCPcfLOHGwnYi5Ai117ls=",
    }
)
"""The public keys in ``configs/``, of which no private keys exist."""
_EXAMPLE_HOST: Final = re.compile(r"(.*\.)?example(\.(com|net|org))?", re.IGNORECASE)  # RFC 2606

_READABLE = (
    "a link through a relay is not confidential: its owner cannot alter the frames, but can read them; write"
    " confidential = true in [link], at one end or both"
)


def advice(config: Config) -> Iterator[str]:
    """Yield the warnings. One that holds for several peers or endpoints comes once."""
    yield from _keys(config)
    about: dict[str, list[str]] = {}
    senders: list[PeerConfig | EndpointConfig] = [*config.peers, *config.endpoints]
    for one in senders:
        for warning in _of_peer(one) if isinstance(one, PeerConfig) else _of_endpoint(one):
            about.setdefault(warning, []).append(_named(one))
    if (fleet := config.fleet) and fleet.relays and fleet.policies and not fleet.link.confidential:
        about.setdefault(_READABLE, []).append("members by certificate")
    yield from (f"{', '.join(names)}: {warning}" for warning, names in about.items())
    yield from _shared(senders)
    vehicles = [_named(peer) for peer in config.peers if peer.policy.get("role") == "vehicle"]
    if config.relays_frames and len(vehicles) > 1:
        yield (
            f'relay = true, and {", ".join(vehicles)} have the role "vehicle": the answers of a vehicle to its'
            " operator (mission items, parameters, file transfer) are writes to another vehicle, so a captured"
            ' vehicle can change the others through this daemon; link them directly as "swarm-member" instead,'
            " or let each vehicle accept only the operator's system_ids"
        )


def examples(config: Config) -> Iterator[str]:
    """Yield what is left from an example, with which no link comes up."""
    for what, settings, addresses in config.others():
        if encode_key(settings.public_key) in EXAMPLE_KEYS:
            yield f"{what}: public_key is of an example, not of a machine: write what `uavlinkd pubkey` prints there"
        for address in addresses:
            if _EXAMPLE_HOST.fullmatch(address.address.host):
                yield f"{what}: {address} is a name for examples: write the address of that machine"


def _keys(config: Config) -> Iterator[str]:
    """Warn of keys that are probably in the wrong place: a person who pastes a private key exposes it."""
    if not looks_private(config.private_key.reveal()):
        yield (
            "private_key_file holds a key without the form of a private key, perhaps a public key: make one with"
            " `uavlinkd keygen`, unless software other than `uavlinkd` and `wg` made it"
        )
    for what, settings, _ in config.others():
        if looks_private(settings.public_key):
            yield (
                f"{what}: public_key has the form of a private key. `uavlinkd keygen` makes no such public key, `wg`"
                " one of 16: compare it with what `uavlinkd pubkey FILE` prints there. If it is the private key of"
                f" that {what.partition(' ')[0]}, it is exposed: make a new one there with"
                " `uavlinkd keygen`, and write here the public key that it prints"
            )


def _named(one: PeerConfig | EndpointConfig) -> str:
    return f'{"peer" if isinstance(one, PeerConfig) else "endpoint"} "{one.name}"'


def _of_peer(peer: PeerConfig) -> Iterator[str]:
    yield from peer.make_policy().warnings
    if peer.relays and not peer.settings.link.confidential:
        yield _READABLE


def _of_endpoint(endpoint: EndpointConfig) -> Iterator[str]:
    for warning in endpoint.make_policy().warnings if endpoint.policy else ():
        # A local client may be any system, unless the file names its systems.
        if "system_ids" in endpoint.policy or not warning.startswith("system_ids"):
            yield warning
    if endpoint.url.is_exposed:
        may = (
            "what its policy passes"
            if endpoint.policy
            else "commands (arm, disarm, take-off, flight termination), missions and parameters to every peer, as if"
            " this vehicle had sent them"
        )
        yield (
            f"plain MAVLink leaves this machine ({endpoint.url}): any sender that reaches that port or path can send"
            f" {may}, and read what the peers send; unless that is intended, write 127.0.0.1"
        )


def _shared(senders: Sequence[PeerConfig | EndpointConfig]) -> Iterator[str]:
    """Warn of system ids and PSKs of two peers. A local client may be another component of a system."""
    for (one, systems), (other, others) in combinations([(sender, sender.systems) for sender in senders], 2):
        if not isinstance(one, PeerConfig):
            return
        if both := sorted(systems & others):
            yield (
                f"{_named(one)} and {_named(other)} may send as the same system {', '.join(map(str, both))}:"
                " receivers cannot distinguish their frames, and one can impersonate the other; unless one carries"
                " the other's frames, allow each system for one of them"
            )
        psk = one.settings.psk
        if psk is not None and isinstance(other, PeerConfig) and psk == other.settings.psk:
            yield (
                f"{_named(one)} and {_named(other)} have the same PSK: an attacker that captures one of them has it"
                " for both; make one for each pair with `uavlinkd psk`"
            )
