"""Facts about the networks behind the sockets. The shell sets them, and all peers of a node share them.

A socket is named by its number in :class:`uavlinkd.core.path.Path`. README.md, sections 14 and 15.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import NamedTuple

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.path import Path
from uavlinkd.core.suites import Suite


class Pace(NamedTuple):
    """How often a peer is asked for an echo, and how long the answer may take. It depends on the best path."""

    interval_s: float = 0.0
    """Between periodic requests, at least."""
    hold_s: float = c.HOLD_S
    """How long frames wait for the peer's proof that they are new, and how old that proof may be."""
    ask_s: float = c.HOLD_ASK_S
    """Between requests meanwhile."""


FREE = Pace()
"""Of a network without a budget."""


class SocketFacts:
    """The facts about each socket. ``metered``: those whose network is paid by the byte."""

    __slots__ = ("_budgets", "_peers", "_rates", "envelope_limits", "metered", "peers_at")

    def __init__(self, metered: Iterable[int] = ()) -> None:
        self.metered = set(metered)
        self._budgets: dict[int, float] = {}
        self._rates: dict[int, float] = {}
        self._peers = 0
        self.envelope_limits: dict[int, int] = {}
        """The longest envelopes that several frames share, in bytes."""
        self.peers_at: dict[int, frozenset[Hashable]] = {}
        """The peers at the other end of each point-to-point network."""

    # Budgets.

    def set_budgets(self, budgets: Mapping[int, float]) -> None:
        """In bits a second."""
        self._budgets = dict(budgets)
        self._rates = dict(budgets)

    def set_rates(self, rates: Mapping[int, float]) -> None:
        """In bits a second, of networks with a budget that carry less at present."""
        self._rates = {**self._budgets, **rates}

    def share_budgets(self, peers: int) -> None:
        """So many peers use each network."""
        self._peers = peers

    def least_probe_s(self, path: Path) -> float:
        """Between questions along a path: every peer may be probed, and sends as many probes as it gets."""
        return self._share_s(path, c.PROBE_BYTES, c.PROBE_BUDGET_SHARE, self._rates)

    def try_interval_s(self, path: Path, suite: Suite) -> float:
        """Between two initiations along a path; 0 without a budget."""
        size = wire.initiation_bytes(suite) + wire.response_bytes(suite)
        return c.TRY_AIRTIMES * self._airtime_s(path, size, self._rates)

    def pace(self, path: Path) -> Pace:
        """That of a peer whose best path this is.

        By the budget, not by the rate: an attacker that delays answers lowers the rate, and must not make the peer
        accept older frames by that.
        """
        airtime_s = self._airtime_s(path, c.ECHO_BYTES, self._budgets)
        if not airtime_s:
            return FREE
        return Pace(
            self._share_s(path, c.ECHO_BYTES, c.ECHO_BUDGET_SHARE, self._budgets),
            min(max(c.HOLD_S, c.HOLD_AIRTIMES * airtime_s), c.LATE_AFTER_S),
            max(c.HOLD_ASK_S, c.ASK_AIRTIMES * airtime_s),
        )

    def _airtime_s(self, path: Path, size: int, rates: Mapping[int, float]) -> float:
        """How long a datagram and its answer, with so many bytes together, take; 0 on a network without a budget."""
        rate = rates.get(path.socket)
        carriers = 2 * (c.LINE_BYTES if path.is_serial else c.IP_BYTES)
        return 0.0 if rate is None else 8 * (size + carriers) / rate

    def _share_s(self, path: Path, size: int, share: float, rates: Mapping[int, float]) -> float:
        peers = 1 if path.socket in self.peers_at else self._peers
        return peers * self._airtime_s(path, size, rates) / share

    # Point-to-point networks.

    def set_point_to_point(self, peers: Mapping[int, Iterable[Hashable]]) -> None:
        """The peers at the other end of each of these sockets; those of all other sockets may have any peer."""
        self.peers_at = {socket: frozenset(those) for socket, those in peers.items()}

    def check_network(self, peer: Hashable, path: Path) -> None:
        """A datagram that names this peer, or is of it, came along a path.

        Raises:
            Drop: ``WRONG_NETWORK`` if there is another peer at the other end of this network.
        """
        peers = self.peers_at.get(path.socket)
        if peers is not None and peer not in peers:
            raise Drop(DropReason.WRONG_NETWORK)
