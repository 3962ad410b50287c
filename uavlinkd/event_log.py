"""What happens to the links, for the log: a line an event, and a bound on the lines that one peer can cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from structlog.typing import FilteringBoundLogger

from uavlinkd.addresses import Address
from uavlinkd.core import outputs as o
from uavlinkd.core.limits import TokenBucket
from uavlinkd.log import MEANINGS, SUMMARY_INTERVAL_S

LINES_PER_S = 0.5
"""Of one peer, on average: some 10 MB a day at worst. Whoever has its key can cause handshakes and new paths."""
LINES_BURST = 50


class EventLog:
    """Writes events of the core. What is left out is counted, and told with the next line of that peer."""

    def __init__(self, log: FilteringBoundLogger) -> None:
        self._log = log
        self._budgets: dict[str, TokenBucket] = {}
        self._omitted: Counter[str] = Counter()
        self._disturbances: dict[str, tuple[Mapping[str, int], float]] = {}  # as told, and when to tell again

    def write(self, event: o.Event, now: float) -> None:
        """Write one, if its peer has a line left. ``now`` is monotonic seconds."""
        budget = self._budgets.setdefault(event.peer, TokenBucket(LINES_PER_S, LINES_BURST, now))
        if not budget.take(now):
            self._omitted[event.peer] += 1
            return
        omitted = self._omitted.pop(event.peer, 0)
        log = self._log.bind(peer=event.peer, **({"omitted_before": omitted} if omitted else {}))
        match event:
            case o.PeerUp():
                log.info("peer_up")
            case o.PeerLost(_, silent_s):
                log.warning("peer_lost", silent_s=round(silent_s, 3))
            case o.PeerClosed():
                log.info("peer_closed")
            case o.PathChanged(_, (_, host, port)):
                log.info("path_changed", path=str(Address(host, port)))
            case o.SessionEstablished() as made:
                log.info(
                    "session_established",
                    generation=made.generation,
                    suite=made.suite,
                    mode="confidential" if made.confidential else "authenticated",
                    tag_bits=8 * made.tag_bytes,
                    initiated_by="us" if made.initiator else "peer",
                    rekey=made.rekey,
                )

    def disturbed(self, peer: str, totals: Mapping[str, int], now: float) -> None:
        """Write what grew of that for which no datagram was dropped, if it is time for a line again.

        Call it about once a second: a line comes when it begins, then one each ``SUMMARY_INTERVAL_S`` a peer.
        """
        told, quiet_until = self._disturbances.get(peer, ({}, now))
        news = {what: total - told.get(what, 0) for what, total in totals.items() if total > told.get(what, 0)}
        if news and now >= quiet_until:
            self._disturbances[peer] = dict(totals), now + SUMMARY_INTERVAL_S
            self._log.warning("link_disturbed", peer=peer, **news, meaning="; ".join(MEANINGS[each] for each in news))

    def forget(self, peer: str) -> None:
        """The peer is no longer configured."""
        self._disturbances.pop(peer, None)
        self._budgets.pop(peer, None)
        self._omitted.pop(peer, None)
