"""The budgets of networks. Every datagram to any peer on a network is charged to its budget."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from uavlinkd.core.constants import LINE_BYTES, RELAY_BYTES
from uavlinkd.core.path import Path
from uavlinkd.link.networks import Networks
from uavlinkd.link.path_status import PathsOwner
from uavlinkd.link.serial_networks import SerialNetworks
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.system.addresses import IPV4_UDP_BYTES, IPV6_UDP_BYTES

COPIES_SHARE: Final = 0.5
"""The part of a budget that copies may use. The rest is for what only this network carries."""
LARGEST_BYTES: Final = 400
"""A bucket holds a largest frame in an envelope, with IP and UDP header."""

RATE_CHANGE: Final = 0.25
"""The core gets a rate that differs by more than this share from the last one that it got."""
LEAST_CORE_SHARE: Final = 0.25
"""The core gets this part of the budget at least: a peer that is lost must not wait minutes for the next try."""


def carrier_bytes(path: Path) -> int:
    """What a network adds to each datagram: headers of IP and UDP, or the framing on a line.

    On a relayed path also what the relay adds. Its own address is not in the path: the longer header counts.
    """
    if path.is_serial:
        return LINE_BYTES
    if path.is_relayed:
        return RELAY_BYTES + IPV6_UDP_BYTES
    return IPV6_UDP_BYTES if ":" in path.host else IPV4_UDP_BYTES


def wire_bytes(datagram: bytes, path: Path) -> int:
    """The bytes of a datagram with what its network adds: IP and UDP header, or the framing on a line."""
    return len(datagram) + carrier_bytes(path)


class NetworkBudget:
    """The budget of one network, and the part of it that copies may use. All peers share both."""

    __slots__ = ("all", "bits_s", "copies", "core_bits_s")

    def __init__(self, budget_bits_s: int, now: float, least_burst: int = LARGEST_BYTES) -> None:
        self.bits_s = budget_bits_s
        self.core_bits_s: float = budget_bits_s
        """The rate that the core has."""
        self.all = Bucket(budget_bits_s, now, least_burst)
        self.copies = Bucket(COPIES_SHARE * budget_bits_s, now, least_burst)

    def set_rate(self, bits_s: float, now: float) -> None:
        """Use another budget from now on."""
        self.all.set_rate(bits_s / 8, now)
        self.copies.set_rate(COPIES_SHARE * bits_s / 8, now)

    def update_core(self, bits_s: float) -> bool:
        """Choose the rate for the core. Returns whether it has changed."""
        rate = max(bits_s, LEAST_CORE_SHARE * self.bits_s)
        is_full_again = rate == self.bits_s != self.core_bits_s
        if not is_full_again and abs(rate - self.core_bits_s) <= RATE_CHANGE * self.core_bits_s:
            return False
        self.core_bits_s = rate
        return True

    def charge(self, datagram: bytes, path: Path, now: float) -> None:
        """Charge a datagram that is sent: an envelope, a handshake message, a probe or any other."""
        self.all.spend(wire_bytes(datagram, path), now)


def budgets_of(networks: Networks | None, serial: SerialNetworks, now: float) -> dict[int, NetworkBudget]:
    """The budget behind each socket number. The sockets of a network share one. Networks without one are left out.

    A serial network's bucket holds one of its envelopes, so that a modem never gets more at once.
    """
    budgets: dict[int, NetworkBudget] = {}
    for line in serial.networks:
        bits_s = line.config.budget_bits_s
        budgets[line.number] = NetworkBudget(bits_s, now, line.envelope_limit + LINE_BYTES)
    for network in () if networks is None else networks.networks:
        if network.config.budget_bits_s:
            budget = NetworkBudget(network.config.budget_bits_s, now)
            budgets.update({one.number: budget for one in network.sockets})
    return budgets


def follow_rates(
    serial: SerialNetworks, budgets: Mapping[int, NetworkBudget], links: Iterable[PathsOwner], now: float
) -> dict[int, float]:
    """Adapt the budgets of serial networks to the answers along them. Call it once a second.

    Returns the rates for the core, by the number of the socket, if one of them has changed.
    """
    if not serial.networks:
        return {}
    for link in links:
        for state in link.peer.paths.states:
            if (line := serial.of_number.get(state.path.socket)) is None:
                continue
            if state.round_trip_s is not None:
                line.add_round_trip(state.round_trip_s, state.answered_at)
            unanswered = link.peer.traffic.echoes_unanswered
            is_asked = state is link.peer.paths.best and not state.is_off
            line.add_unanswered(unanswered, now, is_asked=is_asked)
    has_changed = False
    for line in serial.networks:
        budget, bits_s = budgets[line.number], line.bits_s(now)
        budget.set_rate(bits_s, now)
        has_changed |= budget.update_core(bits_s)
    return {line.number: budgets[line.number].core_bits_s for line in serial.networks} if has_changed else {}
