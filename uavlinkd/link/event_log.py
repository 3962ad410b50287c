"""What happens to the links, for the log: a line an event, and a bound on the lines that anybody can cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from structlog.typing import FilteringBoundLogger

from uavlinkd.system.addresses import Address
from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.limits import TokenBucket
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.key_change import link_name
from uavlinkd.ops.log import MEANINGS, SUMMARY_INTERVAL_S, UNVERIFIED

LINES_PER_S = 0.5
"""Of one peer or endpoint, on average: some 10 MB a day at worst. Whoever has a peer's key can cause handshakes and
new paths, and whoever reaches a ``tcpin`` can connect and leave again."""
LINES_BURST = 50
ENDPOINT_SILENT_S = 10.0
"""An endpoint whose programs say nothing for so long is worth a line: who speaks MAVLink beats each second."""


class EventLog:
    """Writes what happens. What is left out is counted, and told with the next line of that peer or endpoint."""

    def __init__(self, log: FilteringBoundLogger) -> None:
        self._log = log
        self._budgets: dict[tuple[str, str], TokenBucket] = {}  # by peer or endpoint, which may share a name
        self._omitted: Counter[tuple[str, str]] = Counter()
        self._disturbances: dict[str, tuple[Mapping[str, int], float]] = {}  # as told, and when to tell again
        self._frames: dict[str, tuple[int, float]] = {}  # of an endpoint: how many, and when they last grew

    def write(self, event: o.Event, now: float) -> None:
        """Write one, if its peer has a line left. ``now`` is monotonic seconds."""
        omitted = self._take_line("peer", event.peer, now)
        if omitted is None:
            return
        log = self._log.bind(peer=event.peer, **omitted)
        match event:
            case o.PeerUp():
                log.info("peer_up")
            case o.PeerLost(_, silent_s):
                log.warning("peer_lost", silent_s=round(silent_s, 3))
            case o.PeerClosed():
                log.info("peer_closed")
            case o.PathChanged(_, (_, host, port)):
                log.info("path_changed", path=str(Address(host, port)))
            case o.FreshnessUnverified():
                log.warning("freshness_unverified", meaning=UNVERIFIED)
            case o.FreshnessVerified(_, unverified_s):
                log.info("freshness_verified", unverified_s=round(unverified_s, 3))
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

    def program(self, event: str, endpoint: str, program: str, now: float) -> None:
        """Write that a program came or went, if its endpoint has a line left."""
        omitted = self._take_line("endpoint", endpoint, now)
        if omitted is not None:
            self._log.info(event, endpoint=endpoint, program=program, **omitted)

    def unheard(self, peer: str, called_at: Sequence[Address]) -> None:
        """Write that a peer has not been heard for long, and what a person may look at."""
        if called_at:
            meaning = "it is not reachable there, or has another key for us, another PSK, or no common suite"
            self._log.warning("peer_not_answering", peer=peer, called_at=[*map(str, called_at)], meaning=meaning)
        else:
            meaning = "no addresses of it are known here, so it has to call: has its file this daemon's address?"
            self._log.warning("peer_not_calling", peer=peer, meaning=meaning)

    def look_at(self, endpoint: Endpoint, now: float) -> None:
        """Write, once, that nothing comes from the programs of an endpoint. Call it about once a second."""
        frames, since = self._frames.get(endpoint.name, (-1, now))
        if not endpoint.ports or endpoint.counters.frames != frames:
            self._frames[endpoint.name] = endpoint.counters.frames, now
        elif now - since >= ENDPOINT_SILENT_S:
            self._frames[endpoint.name] = frames, NEVER
            self._log.warning(
                "endpoint_silent",
                endpoint=endpoint.name,
                programs=[port.name for port in endpoint.ports],
                garbage_bytes=endpoint.counters.garbage_bytes,
                meaning="no MAVLink comes: is it on, is MAVLink on at that port, with that speed and wiring, and does"
                " nothing else read it? Or the program is closed, or only listens",
            )

    def forget_endpoint(self, name: str) -> None:
        """The endpoint was closed: another one of its name begins anew."""
        self._frames.pop(name, None)

    def _take_line(self, kind: str, name: str, now: float) -> dict[str, int] | None:
        """What to say of lines that were left out before this one; None where this one is to be left out too."""
        if not self._budgets.setdefault((kind, name), TokenBucket(LINES_PER_S, LINES_BURST, now)).take(now):
            self._omitted[kind, name] += 1
            return None
        omitted = self._omitted.pop((kind, name), 0)
        return {"omitted_before": omitted} if omitted else {}

    def disturbed(self, peer: str, totals: Mapping[str, int], now: float) -> None:
        """Write what grew of that for which no datagram was dropped, if it is time for a line again.

        Call it about once a second: a line comes when it begins, then one each ``SUMMARY_INTERVAL_S`` a peer. Totals
        that are smaller than those before began anew: what they have by then is not told, what comes on top is.
        """
        before, quiet_until = self._disturbances.get(peer, ({}, now))
        told = {what: min(before.get(what, 0), total) for what, total in totals.items()}
        news = {what: total - told[what] for what, total in totals.items() if total > told[what]}
        if not news or now < quiet_until:
            self._disturbances[peer] = told, quiet_until
        else:
            self._disturbances[peer] = dict(totals), now + SUMMARY_INTERVAL_S
            self._log.warning("link_disturbed", peer=peer, **news, meaning="; ".join(MEANINGS[each] for each in news))

    def forget(self, peer: str) -> None:
        """The peer is no longer configured. The core may have had it by previous keys too."""
        for name in [each for each in self._disturbances if link_name(each) == peer]:
            del self._disturbances[name]
        for key in [each for each in self._budgets if each[0] == "peer" and link_name(each[1]) == peer]:
            del self._budgets[key]
            self._omitted.pop(key, None)
