"""Rules about ``[[network]]``: its keys, ``listen``, the addresses of peers, and the other end of a serial line."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from uavlinkd.config.file import File, Found
from uavlinkd.config.model import SERIAL, NetworkConfig, PeerAddress
from uavlinkd.config.section import Values
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
    """The network. This end sends the least of its budget, its part of the radio's rate, and the line's rate."""
    values = {key: section.get(key) for key in section.keys}
    line, air_bits_s, limits = values["serial"], values["air_bits_s"] or 0, [values["budget_bits_s"]]
    if line is not None:
        usual = USUAL_AIR_BITS_S if line.baud >= USUAL_BAUD else int(SLOW_LINE_SHARE * line.baud)
        air_bits_s = air_bits_s or usual
        limits.append(8 * line.baud // _BITS_PER_BYTE)
    limits.append(int(SENDING_SHARE * air_bits_s))
    least = min((limit for limit in limits if limit), default=0)
    return NetworkConfig(**{**values, "air_bits_s": air_bits_s, "budget_bits_s": least})


def check(file: File) -> Found:
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
