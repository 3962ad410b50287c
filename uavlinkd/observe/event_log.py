"""Events of the links in the log, with a limit on the lines that an attacker can cause."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping

from structlog.typing import FilteringBoundLogger

from uavlinkd.observe.conditions import Conditions, Limit, OpenCondition, Phase
from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.ops.log import shown
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.path import Path

FINDING_DELAY_S = 2.0
"""A finding is logged if it lasts for so long; one about an attack at once. Three lost answers in a row make a moment
of unverified freshness, which 1 % of loss causes about once a day."""
ENDPOINT_DELAY_S = 15.0
"""A finding about an endpoint is logged if it lasts for so long: its client may restart."""
ENDED_PROBLEMS = 100
"""Findings that ended, at most, that are kept for a page that shows them."""
FINDING_QUIET_S = 10.0
"""A finding has ended when it was absent for so long, see :data:`uavlinkd.observe.conditions.QUIET_S`."""

_OTHER_EVENTS = frozenset({"network_absent", "configuration_refused", "fault_inside"})
"""Findings that are logged by events of their own."""
_State = o.PeerUp | o.PeerLost | o.PeerClosed
_FindingKey = tuple[str, Subject, str]


class EventLog:
    """Writes events. The next line of a peer or endpoint has the count of the lines that its limit omitted."""

    def __init__(
        self,
        log: FilteringBoundLogger,
        limits: LineLimits | None = None,
        network_of: Callable[[int], str | None] = lambda _: None,
    ) -> None:
        self._log = log
        self._limits = limits or LineLimits()
        self._network_of = network_of
        self._omitted_states: dict[str, _State] = {}  # the latest that a limit omitted, by name in the core
        self._findings: dict[_FindingKey, Finding] = {}
        self._present: dict[_FindingKey, float] = {}  # since when
        self._ended = deque[tuple[Finding, float, float]](maxlen=ENDED_PROBLEMS)  # when they began and ended
        self._finding_conditions = Conditions[_FindingKey](
            self._limits,
            self._write_finding,
            lambda key: Limit("finding", key[2], self._findings[key].severity is Severity.SECURITY),
            FINDING_QUIET_S,
        )

    def check(self, now: float) -> None:
        """Write the lines that are due. Call it every second or two."""
        for name, state in list(self._omitted_states.items()):
            if (omitted := self._limits.take("peer", name, now)) is not None:
                del self._omitted_states[name]
                self._write_event(state, omitted)
        self._finding_conditions.check(now)

    def close(self) -> None:
        """Write the ends of all conditions: the daemon stops."""
        self._finding_conditions.close()

    def forget(self, peer: str) -> None:
        """Forget a peer that was removed."""
        self._finding_conditions.close(lambda key: key[1] is Subject.PEER and key[2] == peer)
        self._omitted_states.pop(peer, None)
        self._limits.forget(peer)

    # Events of the core.

    def write(self, event: o.Event, now: float) -> None:
        """Write an event, within the limit of its peer. ``now`` is monotonic seconds."""
        name = event.peer.name
        is_debug = isinstance(event, o.SessionEstablished) and event.rekey
        kind = "debug" if is_debug else "peer"
        omitted = self._limits.take(kind, name, now)
        if omitted is None:
            if not isinstance(event, _State) or name in self._omitted_states:
                self._limits.omit(kind, name)
            if isinstance(event, _State):  # it is written later: the log ends with the state of the link
                self._omitted_states[name] = event
            return
        if not is_debug and self._omitted_states.pop(name, None) is not None:
            omitted["omitted_before"] = omitted.get("omitted_before", 0) + 1
        self._write_event(event, omitted)

    def _write_event(self, event: o.Event, omitted: Mapping[str, int]) -> None:
        log = self._log.bind(peer=event.peer.name, **omitted)
        match event:
            case o.PeerUp():
                log.info("peer_up")
            case o.PeerLost(_, silent_s):
                log.warning("peer_lost", silent_s=round(silent_s, 3))
            case o.PeerClosed():
                log.info("peer_closed")
            case o.PathChanged(_, path, before, reason):
                log = log.bind(**self._path_facts("path", "network", path))
                log.info("path_changed", **self._path_facts("before", "network_before", before), reason=reason)
            case o.PathStateChanged(_, path, is_usable, reason):
                log = log.bind(**self._path_facts("path", "network", path), reason=reason)
                if is_usable:
                    log.info("path_usable")
                elif reason != "closed":  # which `relay_disconnected` explains, often on purpose
                    log.warning("path_down")
            case o.SessionEstablished(rekey=True):
                log.debug("session_established", **_session_facts(event))
            case o.SessionEstablished():
                log.info("session_established", **_session_facts(event))

    def _path_facts(self, address_field: str, network_field: str, path: Path) -> dict[str, str]:
        facts = {address_field: shown(path.address)}
        network = self._network_of(path.socket)
        return facts if network is None else {**facts, network_field: network}

    def write_client(self, event: str, endpoint: str, client: str, now: float) -> None:
        """Write that a client connected or disconnected, within the limit of its endpoint."""
        omitted = self._limits.take("client", endpoint, now)
        if omitted is None:
            self._limits.omit("client", endpoint)
        else:
            self._log.info(event, endpoint=endpoint, client=client, **omitted)

    # Conditions.

    def write_pause(self, pause_s: float, now: float) -> None:
        """Write that the process was paused."""
        omitted = self._limits.take("pause", "", now)
        if omitted is None:
            self._limits.omit("pause", "")
        else:
            self._log.warning("daemon_paused", seconds=round(pause_s, 3), **omitted)

    def write_findings(self, findings: Iterable[Finding], now: float) -> None:
        """Note the present findings. Call it every second or two."""
        present = {}
        for finding in findings:
            if finding.cause in _OTHER_EVENTS:
                continue
            key = finding.cause, finding.subject, finding.name
            present[key] = since = self._present.get(key, now)
            self._findings[key] = finding
            delay_s = ENDPOINT_DELAY_S if finding.subject is Subject.ENDPOINT else FINDING_DELAY_S
            is_urgent = finding.severity is Severity.SECURITY or key in self._finding_conditions
            if is_urgent or now - since >= delay_s:
                self._finding_conditions.note(key, now)
        self._present = present

    def problems(self, now: float) -> list[dict[str, object]]:
        """The findings of the log that last, and the latest that ended. ``began_s`` and ``ended_s`` are ages."""
        lasting = ((self._findings[key], one.began_at, None) for key, one in self._finding_conditions.logged())
        return [
            {**finding.as_json(), "began_s": now - began, "ended_s": None if ended is None else now - ended}
            for finding, began, ended in (*self._ended, *lasting)
        ]

    def _write_finding(
        self, key: _FindingKey, phase: Phase, condition: OpenCondition, omitted: dict[str, int]
    ) -> None:
        finding = self._findings[key]
        if phase is Phase.ENDED:
            self._ended.append((finding, condition.began_at, condition.seen_at))
            facts = {field: fact for field, fact in finding.as_json().items() if field not in ("text", "remedy")}
            self._log.info("problem_ended", **facts, duration_s=condition.duration_s, **omitted)
            return
        is_intended = finding.cause == "commands_withheld"  # if the role is right
        log = self._log.info if is_intended else self._log.warning
        if finding.severity is Severity.SECURITY:
            log = self._log.error
        if phase is Phase.BEGAN:
            log("problem_began", **finding.as_json(), **omitted)
        elif not is_intended:
            log("problem_continued", **finding.as_json(), duration_s=condition.duration_s, **omitted)


def _session_facts(session: o.SessionEstablished) -> dict[str, object]:
    return {
        "generation": session.generation,
        "suite": session.suite,
        "mode": "confidential" if session.confidential else "authenticated",
        "tag_bits": 8 * session.tag_bytes,
        "initiated_by": "us" if session.initiator else "peer",
        "rekey": session.rekey,
    }
