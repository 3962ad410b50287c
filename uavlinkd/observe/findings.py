"""The findings of a moment: the rows of :mod:`.table` whose sign is there.

They are computed every four seconds and when a client asks for the status.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.io.ports import Endpoint
from uavlinkd.observe import table, traffic_signs
from uavlinkd.observe.facts import EndpointFacts, Moment, PartFacts, PeerFacts
from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.observe.history import History
from uavlinkd.observe.table import ROWS, Exit, Row

_ABSENT_CLIENTS: Final = frozenset(row.cause for row in table.OF_ENDPOINT if row.exit is Exit.EVERYWHERE)
_STOPPING: Final = frozenset((row.cause, row.severity) for row in ROWS if row.exit is Exit.FAILED)
_CODES: Final = {row.cause: row.code for row in ROWS if row.code}


def find(daemon: DaemonParts, history: History, now: float) -> list[Finding]:
    """All present findings: security first, then faults, then warnings; by subject and name among equals."""
    moment = Moment(daemon, history, now)
    findings = [*_present(table.OF_DAEMON, moment, Subject.DAEMON, "")]
    for link in daemon.links.values():
        peer = PeerFacts(moment, link)
        findings += _present(table.OF_PEER, peer, Subject.PEER, link.name)
        rows = table.OF_PEER_UP if peer.is_up else table.OF_PEER_DOWN
        of_state = list(_present(rows, peer, Subject.PEER, link.name))
        if not (of_state or peer.is_up or peer.lacks_relay):
            of_state = list(_present(table.OF_PEER_SILENT, peer, Subject.PEER, link.name))
        findings += of_state
    configs = {config.name: config for config in daemon.config.endpoints}
    for endpoint in daemon.local.endpoints:
        if (config := configs.get(endpoint.name)) is not None:
            facts = EndpointFacts(moment, endpoint, config)
            findings += _present(table.OF_ENDPOINT, facts, Subject.ENDPOINT, endpoint.name)
    return sorted(findings, key=lambda one: (one.severity, one.subject, one.name))


def _present(rows: Sequence[Row], facts: Moment | PartFacts, subject: Subject, name: str) -> Iterator[Finding]:
    causes = set[str]()
    for row in rows:
        if causes.isdisjoint(row.unless):
            for fields in row.sign(facts):
                causes.add(row.cause)
                known = facts.fields | fields
                severity = Severity[known["severity"].upper()] if "severity" in known else row.severity
                text, remedy = row.text.format_map(known), row.remedy.format_map(known)
                yield Finding(row.cause, severity, subject, name, text, remedy)


def has_no_client(findings: Iterable[Finding], endpoints: Iterable[Endpoint]) -> bool:
    """Whether by the findings none of the endpoints has a client. A station that is off does not count."""
    present = sum(not one.is_station or bool(one.ports) for one in endpoints)
    return 0 < present == sum(one.cause in _ABSENT_CLIENTS for one in findings)


def stop_frames(findings: Iterable[Finding]) -> bool:
    """Whether one of the findings alone makes ``status`` fail."""
    return any((one.cause, one.severity) in _STOPPING for one in findings)


def own_codes(findings: Iterable[Finding], *, is_cut_off: bool) -> list[int]:
    """The codes that peers get of this daemon's findings, except those about peers. ``is_cut_off``: no endpoint has
    a client.
    """
    codes = {_CODES.get(one.cause, 0) for one in findings if one.subject is not Subject.PEER}
    if is_cut_off:  # it says the same of every endpoint
        codes = codes - {_CODES["no_client"]} | {traffic_signs.CUT_OFF}
    return [code for code in traffic_signs.PROBLEMS if code in codes]
