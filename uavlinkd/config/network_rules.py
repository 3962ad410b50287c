"""Rules about ``[[network]]``: its keys, ``listen``, the addresses of peers, and the other end of a serial line."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from uavlinkd.config.file import File, Found
from uavlinkd.config.model import SERIAL, NetworkConfig, PeerAddress
from uavlinkd.config.section import Values
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
_EXITS: Final = ("interface", "address", "serial")


def network_of(section: Values) -> NetworkConfig:
    values = {key: section.get(key) for key in section.keys}
    air_bits_s = 0 if values["serial"] is None else _air_bits_s(section)
    budget_bits_s = int(SENDING_SHARE * air_bits_s) or values["budget_bits_s"]
    return NetworkConfig(**{**values, "air_bits_s": air_bits_s, "budget_bits_s": budget_bits_s})


def _air_bits_s(section: Values) -> int:
    """What the radio carries, or is assumed to carry; 0 if the file must say."""
    line: SerialUrl = section.get("serial")
    if written := section.get("air_bits_s"):
        return int(written)
    if line.baud == USUAL_BAUD:
        return USUAL_AIR_BITS_S
    return int(SLOW_LINE_SHARE * line.baud) if line.baud < USUAL_BAUD else 0


def used_networks(networks: Iterable[NetworkConfig], written: PeerAddress) -> Iterator[NetworkConfig]:
    """The networks along which the daemon uses an address of a peer."""
    for network in networks:
        if written.is_serial or network.serial is not None:
            if written.is_serial and network.serial is not None and written.network == network.name:
                yield network
        elif written.network in ("", network.name) and _may_reach(network, written.address):
            yield network


def _may_reach(network: NetworkConfig, address: Address) -> bool:
    """Whether the texts permit it: the same family, and the same interface of a link-local address."""
    zone = address.host.partition("%")[2]
    if address.family != socket.AF_UNSPEC and address.family not in network.families:
        return False
    return not zone or zone.isdigit() or network.interface in (None, zone)


def networks(file: File) -> Found:
    """Each network is one exit of its own, and each address of a peer can be reached along a network."""
    sections, peers = file["network"], (*file["peer"], *file["relay"], *file["contact"])
    for section in sections:
        yield from _exit(section)
    if any(key in section.valid for section in sections for key in ("interface", "address")):
        yield from _listen(file.top)
    if any(section.invalid or _problem_of_exits(section) for section in sections):
        return  # the rest would follow from these problems
    configs = [network_of(section) for section in sections]
    for peer in peers:
        for written in peer.get("addresses"):
            if message := _wrong(written, configs):
                yield peer.at("addresses"), message
    if not any("addresses" in peer.invalid for peer in peers):
        yield from _other_ends(sections, peers)


def _problem_of_exits(section: Values) -> bool:
    return sum(key in section.valid for key in _EXITS) != 1


def _exit(section: Values) -> Found:
    """A network has one exit. A serial one has a rate that its line carries."""
    if _problem_of_exits(section) and not section.invalid.intersection(_EXITS):
        yield (
            section.at(),
            'has no exit, or several: write one of interface = "wwan0", address = "10.0.0.5" with an address of this'
            ' machine, or serial = "/dev/ttyUSB0:57600"',
        )
    if "serial" not in section.valid:
        if "air_bits_s" in section.valid and "serial" not in section.invalid:
            yield section.at("air_bits_s"), "is for a radio behind a serial device: write budget_bits_s instead"
        return
    for key in ("metered", "budget_bits_s"):
        if section.get(key):
            text = (
                f"is for networks that are not serial: leave it out; this end sends {SENDING_SHARE:.0%} of air_bits_s"
            )
            yield section.at(key), text
    air, baud = _air_bits_s(section), section.get("serial").baud
    if not air and "air_bits_s" not in section.invalid:
        yield (
            section.at("air_bits_s"),
            f"is missing: at {baud} baud the line does not show what the radio carries. Write the bits per"
            f" second of both directions together, about half of the modem's air rate, such as {USUAL_AIR_BITS_S}",
        )
    elif SENDING_SHARE * air / 8 > baud / _BITS_PER_BYTE:
        text = f"is more than a line of {baud} baud carries: write less, or raise the baud rate"
        yield section.at("air_bits_s"), text


def _listen(top: Values) -> Found:
    """With networks, ``listen`` has only the ports of their sockets, at most one of each IP version."""
    listen: list[Address] = top.get("listen")
    if len({address.family for address in listen}) < len(listen) or not all(one.is_wildcard for one in listen):
        yield (
            "listen",
            "has more than a port for each IP version, but the networks of this file decide where the daemon listens:"
            f" write {listen[0].wildcard()} for this port on each network",
        )


def _wrong(written: PeerAddress, configs: Sequence[NetworkConfig]) -> str | None:
    """What is wrong with an address of a peer, if no network can have it."""
    if any(used_networks(configs, written)):
        return None
    named = {config.name: config for config in configs}
    if not written.network and (written.address.resource or all(config.serial for config in configs)):
        return None
    if not written.network:
        reason = "which no network of this file can reach"
    elif (network := named.get(written.network)) is None:
        names = ", ".join(f'"{name}"' for name in sorted(named)) or "none"
        return f'names a network "{written.network}" that this file does not have: the file has {names}'
    elif network.serial is not None or written.is_serial:
        return (
            f"names {written}, but only a serial network has no address, and needs none: write"
            f' {{ network = "sik" }} for a serial network, or {{ address = "10.13.0.2:5790", network = "mesh" }}'
        )
    else:
        reason = "which that network cannot reach"
    text = "the IP version is another one, or the interface of a link-local address"
    return f"names {written}, {reason}: {text}; write another address or network"


def _other_ends(sections: Iterable[Values], peers: Sequence[Values]) -> Found:
    """Each serial network has one peer, which names it without an address."""
    for section in sections:
        if section.get("serial") is None:
            continue
        name = section.get("name")
        users = [peer for peer in peers if PeerAddress(SERIAL, name) in peer.get("addresses")]
        if len(users) != 1:
            problem = f"is named by {users[0].at()} and {users[1].at()}" if users else "has no peer at its other end"
            text = (
                f'{problem}: write addresses = [{{ network = "{name}" }}] in the [[peer]] or [[contact]] of that end'
            )
            yield section.at("serial"), text
