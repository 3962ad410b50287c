"""Rules about ``[[network]]``: between its keys, ``listen``, and the addresses of peers."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Sequence

from uavlinkd.config import serial_rules
from uavlinkd.config.checks import unique
from uavlinkd.config.model import NetworkConfig, PeerAddress
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import NetworkSection
from uavlinkd.system.addresses import Address

_FAMILIES = {socket.AF_INET: "IPv4", socket.AF_INET6: "IPv6"}


def networks(
    problems: Problems,
    top: Values,
    sections: Sequence[Values],
    peers: Sequence[Values],
    endpoints: Iterable[Values],
) -> None:
    """Each network is one exit of its own, and each address of a peer can be reached along a network."""
    unique(problems, sections, "name", str, "the name of {other} too: write another")
    for key in ("interface", "address"):
        unique(problems, sections, key, str, f"the {key} of {{other}} too: write another, or remove one network")
    for section in sections:
        _exit(problems, section)
        serial_rules.serial_network(problems, section)
    serial_rules.devices(problems, sections, endpoints)
    if any({"interface", "address"} & _exits(section) for section in sections):
        _listen(problems, top)
    known = {section.valid["name"] for section in sections if "name" in section.valid}
    if len(known) < len(sections) or any(len(_exits(section)) != 1 or section.invalid for section in sections):
        return  # the rest would follow from the problems so far
    configs = [config for config in map(network_of, sections) if config.serial is None]
    serial_rules.other_ends(problems, sections, peers)
    for peer in peers:
        key = peer.place.key("addresses")
        for written in peer.valid.get("addresses", ()):
            if written.is_serial or known - {config.name for config in configs} >= {written.network}:
                continue  # with a serial network
            if written.network and written.network not in known:
                problems.add(
                    key, f"names a network for {written.address} that this file does not have: {_known(known)}"
                )
            elif configs and not any(used_networks(configs, written)):
                problems.add(key, f"names {written}, which no network can reach: {_why(written)}")


def network_of(section: Values) -> NetworkConfig:
    """The network of a valid section."""
    keys = NetworkSection.model_construct(**section.valid)
    air_bits_s = serial_rules.air_bits_s(section)
    budget_bits_s = int(serial_rules.SENDING_SHARE * air_bits_s) if air_bits_s else keys.budget_bits_s
    return NetworkConfig(
        keys.name, keys.interface, keys.address, keys.metered, budget_bits_s, keys.serial, air_bits_s
    )


def used_networks(networks: Iterable[NetworkConfig], written: PeerAddress) -> Iterator[NetworkConfig]:
    """The networks along which the daemon uses an address of a peer."""
    for network in networks:
        if written.is_serial != (network.serial is not None):
            continue
        if written.is_serial:
            if written.network == network.name:
                yield network
        elif written.network in ("", network.name) and _may_reach(network, written.address):
            yield network


def _exits(section: Values) -> set[str]:
    return {"interface", "address", "serial"} & (set(section.valid) | section.invalid)


def _exit(problems: Problems, section: Values) -> None:
    written = _exits(section)
    if "serial" in written:
        return  # see serial_rules
    if len(written) > 1:
        problems.add(
            section.place.key("interface"),
            "and address are both written, but a network has one exit: remove one of them, or write two networks",
        )
    elif not written:
        problems.add(
            section.place.key("interface"),
            'is missing: write interface = "wwan0", address = "10.0.0.5" with an address of this machine, or'
            ' serial = "/dev/ttyUSB0:57600"',
        )


def _listen(problems: Problems, top: Values) -> None:
    """With networks, ``listen`` has only the ports of their sockets."""
    families = list[socket.AddressFamily]()
    for address in top.valid.get("listen", ()):
        if not address.is_wildcard:
            wildcard = Address("::" if address.family == socket.AF_INET6 else "0.0.0.0", address.port)
            problems.add(
                "listen",
                f"names {address}, but the networks of this file decide where the daemon listens: write"
                f' "{wildcard}" for this port on each network',
            )
        elif address.family in families:
            problems.add(
                "listen",
                f"names two ports for {_FAMILIES[address.family]}, but each network has one socket of a family:"
                " write one",
            )
        families.append(address.family)


def _may_reach(network: NetworkConfig, address: Address) -> bool:
    """Whether the texts permit it: the same family, and the same interface of a link-local address."""
    zone = address.host.partition("%")[2]
    if address.family != socket.AF_UNSPEC and address.family not in network.families:
        return False
    return not zone or zone.isdigit() or network.interface in (None, zone)


def _known(known: Iterable[str]) -> str:
    names = ", ".join(f'"{name}"' for name in sorted(known))
    return f"write one of {names}" if names else "add a [[network]] of that name, or write the address alone"


def _why(written: PeerAddress) -> str:
    if zone := written.address.host.partition("%")[2]:
        return f"it is valid on the interface {zone} only; write that network"
    family = _FAMILIES[written.address.family]
    which = "that network has" if written.network else "the networks of this file have"
    return f"{which} no address of {family}; write another address, or a network with an interface"
