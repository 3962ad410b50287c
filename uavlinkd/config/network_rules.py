"""Rules about ``[[network]]``: its keys, ``listen``, the addresses of peers, and the other end of a serial line."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from uavlinkd.config.model import NetworkConfig, PeerAddress
from uavlinkd.config.problems import Found, Sections, Values, unique
from uavlinkd.config.schema import NetworkSection
from uavlinkd.io.url import SerialUrl
from uavlinkd.system.addresses import Address

USUAL_BAUD: Final = 57600  # the baud rate of SiK modems as they are sold
USUAL_AIR_BITS_S: Final = 24_000
"""What such a modem carries by radio, in both directions together, beside its own overhead and turn-around times."""
SLOW_LINE_SHARE: Final = 0.4
"""Of the baud rate of a slower line: what is assumed that its radio carries."""
SENDING_SHARE: Final = 0.4
"""The part of the radio's rate that each end uses. The rest is for collisions, turn-around times and noise."""
_BITS_PER_BYTE: Final = 10  # on a wire, with start and stop bit
_FAMILIES = {socket.AF_INET: "IPv4", socket.AF_INET6: "IPv6"}


def networks(file: Sections) -> Found:
    """Each network is one exit of its own, and each address of a peer can be reached along a network."""
    sections, peers = file.networks, (*file.peers, *file.relays, *file.contacts)
    yield from unique(sections, "name", "the name of {other} too: write another")
    for key in ("interface", "address"):
        yield from unique(sections, key, f"the {key} of {{other}} too: write another, or remove one network")
    for section in sections:
        yield from _exit(section)
    yield from _devices(file)
    if any({"interface", "address"} & _exits(section) for section in sections):
        yield from _listen(file.top)
    known = {section.valid["name"] for section in sections if "name" in section.valid}
    if len(known) < len(sections) or any(len(_exits(section)) != 1 or section.invalid for section in sections):
        return  # the rest would follow from the problems so far
    configs = [config for config in map(network_of, sections) if config.serial is None]
    serial = known - {config.name for config in configs}
    yield from _other_ends(sections, serial, peers)
    for peer in peers:
        for written in peer.get("addresses", ()):
            if message := _wrong(written, known, serial, configs):
                yield peer.at("addresses"), message


def _wrong(written: PeerAddress, known: set[str], serial: set[str], configs: Sequence[NetworkConfig]) -> str | None:
    """What is wrong with an address of a peer, if the networks cannot have it."""
    if written.is_serial and written.network not in serial:
        names = " or ".join(f'"{name}"' for name in sorted(serial))
        return (
            f'names "{written.network}" without an address, which only a serial network may have: write'
            f' {{ address = "10.13.0.2:5790", network = "{written.network}" }}'
            + (f", or the serial network {names}" if names else "")
        )
    if written.network in serial and not written.is_serial:
        return (
            f'names {written.address} on "{written.network}", a serial network, which has no addresses: write'
            f' {{ network = "{written.network}" }}'
        )
    if written.network and written.network not in known:
        names = ", ".join(f'"{name}"' for name in sorted(known))
        remedy = f"write one of {names}" if names else "add a [[network]] of that name, or write the address alone"
        return f"names a network for {written.address} that this file does not have: {remedy}"
    if written.is_serial or written.address.resource or not configs or any(used_networks(configs, written)):
        return None
    family = f"no address of {_FAMILIES.get(written.address.family)}"
    if zone := written.address.host.partition("%")[2]:
        reason = f"it is valid on the interface {zone} only; write that network"
    elif written.network:
        reason = f"that network has {family}; write another address, or a network with an interface"
    else:
        reason = f"the networks of this file have {family}; write another address, or a network with an interface"
    return f"names {written}, which no network can reach: {reason}"


def network_of(section: Values) -> NetworkConfig:
    keys = NetworkSection(section.valid)
    air_bits_s = 0 if keys.serial is None else _air_bits_s(section, keys.serial)
    budget_bits_s = int(SENDING_SHARE * air_bits_s) if air_bits_s else keys.budget_bits_s
    return NetworkConfig(
        keys.name, keys.interface, keys.address, keys.metered, budget_bits_s, keys.serial, air_bits_s
    )


def used_networks(networks: Iterable[NetworkConfig], written: PeerAddress) -> Iterator[NetworkConfig]:
    """The networks along which the daemon uses an address of a peer."""
    for network in networks:
        if written.is_serial or network.serial is not None:
            if written.is_serial and network.serial is not None and written.network == network.name:
                yield network
        elif written.network in ("", network.name) and _may_reach(network, written.address):
            yield network


def _exits(section: Values) -> set[str]:
    return {"interface", "address", "serial"} & (set(section.valid) | section.invalid)


def _exit(section: Values) -> Found:
    """A network has one exit. A serial one has a rate that its line carries."""
    written, line = _exits(section), section.get("serial")
    if len(written) != 1:
        yield (
            section.at(next((key for key in ("serial", "address") if key in written), "interface")),
            f"{'is missing' if not written else 'is one of several exits, but a network has one'}: write one of"
            ' interface = "wwan0", address = "10.0.0.5" with an address of this machine, or'
            ' serial = "/dev/ttyUSB0:57600"',
        )
    needs_serial = 'is for a radio behind a serial device: write serial = "/dev/ttyUSB0:57600" too, or budget_bits_s'
    for key, is_wrong, text in (
        ("metered", line, "is for networks that cost money, and this is a serial line: leave it out"),
        ("budget_bits_s", line, f"does not go with serial: write air_bits_s ({SENDING_SHARE:.0%} is this end's)"),
        ("air_bits_s", "serial" not in written, f"{needs_serial} instead"),
    ):
        if is_wrong and section.get(key):
            yield section.at(key), text
    if line is None or "air_bits_s" in section.invalid:
        return
    if not (air := _air_bits_s(section, line)):
        yield (
            section.at("air_bits_s"),
            f"is missing: at {line.baud} baud the line does not show what the radio carries. Write the bits per"
            f" second of both directions together, about half of the modem's air rate, such as {USUAL_AIR_BITS_S}",
        )
    elif SENDING_SHARE * air / 8 > line.baud / _BITS_PER_BYTE:
        text = f"is more than a line of {line.baud} baud carries: write less, or raise the baud rate"
        yield section.at("air_bits_s"), text


def _air_bits_s(section: Values, line: SerialUrl) -> int:
    """What the radio carries, or is assumed to carry; 0 if the file must say."""
    if written := section.get("air_bits_s"):
        return int(written)
    if line.baud == USUAL_BAUD:
        return USUAL_AIR_BITS_S
    return int(SLOW_LINE_SHARE * line.baud) if line.baud < USUAL_BAUD else 0


def _devices(file: Sections) -> Found:
    """A device has one user: a network or an endpoint."""
    users: dict[str, Values] = {}
    for section in (*file.endpoints, *file.networks):
        key = "url" if section.kind == "endpoint" else "serial"
        line = section.get(key)
        if not isinstance(line, SerialUrl):
            continue
        if (other := users.setdefault(os.path.realpath(line.device), section)) is not section:
            yield section.at(key), f"is the device of {other.at()} too, and only one can open it: write another"


def _other_ends(sections: Iterable[Values], serial: set[str], peers: Sequence[Values]) -> Found:
    """Each serial network has one peer, which names it without an address."""
    users: dict[str, Values] = {}
    for peer in peers:
        for written in peer.get("addresses", ()):
            is_end = written.is_serial and written.network in serial
            if is_end and users.setdefault(written.network, peer) is not peer:
                yield (
                    peer.at("addresses"),
                    f'names the serial network "{written.network}", whose other end is {users[written.network].at()}:'
                    " a line has one peer; write it for one of them",
                )
    for section in sections if not any("addresses" in peer.invalid for peer in peers) else ():
        if (name := section.valid["name"]) in serial - set(users):
            text = f'has no peer at its other end: write addresses = [{{ network = "{name}" }}]'
            yield section.at("serial"), f"{text} in its [[peer]] or [[contact]]"


def _listen(top: Values) -> Found:
    """With networks, ``listen`` has only the ports of their sockets."""
    families = list[socket.AddressFamily]()
    for address in top.get("listen", ()):
        if not address.is_wildcard:
            wildcard = Address("::" if address.family == socket.AF_INET6 else "0.0.0.0", address.port)
            yield (
                "listen",
                f"names {address}, but the networks of this file decide where the daemon listens: write"
                f' "{wildcard}" for this port on each network',
            )
        elif address.family in families:
            text = f"names two ports for {_FAMILIES[address.family]}, but each network has one socket of a family"
            yield "listen", f"{text}: write one"
        families.append(address.family)


def _may_reach(network: NetworkConfig, address: Address) -> bool:
    """Whether the texts permit it: the same family, and the same interface of a link-local address."""
    zone = address.host.partition("%")[2]
    if address.family != socket.AF_UNSPEC and address.family not in network.families:
        return False
    return not zone or zone.isdigit() or network.interface in (None, zone)
