"""The switch: knows every port and its policy, and decides where the frames of a flow go.

A port is a local client or a peer. A flow is the frames of a source with one header. The switch asks policy and
router about the first of them, and remembers the answer: :mod:`.line` looks it up for the others. Where a frame can
arrive again, it costs the check whether it is new too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import NamedTuple

from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.io.ports import LocalPort
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.routing import Router
from uavlinkd.mavlink.vehicles import REPORTS

MAX_FLOWS = 2048
"""Flows of one source that are remembered."""

Port = LocalPort | PeerLink


class Route(NamedTuple):
    """Where the frames of one source with one header go."""

    ports: tuple[Port, ...]
    comes_once: bool
    """No other port may send frames of this system, and none goes from one local client to another: all are new."""
    is_conditional: bool
    """A policy decides about each frame, by its contents or by a rate limit, or the status shows its contents.
    Otherwise all of them pass."""


@dataclass(slots=True, eq=False)
class KnownPort:
    """What the switch knows of a port."""

    policy: Policy
    source: Source
    number: int
    """What a policy's rate limits know it by. A number is never used again."""
    flows: dict[Header, Route] = field(default_factory=dict)


class Switch:
    """The ports, their policies, and the flows that are known. All times are monotonic seconds."""

    def __init__(self, router: Router[Port], drops: DaemonJournal) -> None:
        self.router = router
        self._drops = drops
        self._report = partial(drops.add_refused, to_them=False)
        self.ports: dict[Port, KnownPort] = {}
        """All that there are."""
        self._unused = count()
        self._senders: dict[int, int] = {}
        """By system: how many ports may send its frames."""

    def add(self, port: Port, policy: Policy) -> None:
        """Accept frames from this port, and send frames to it, as far as its policy allows."""
        source = Source(owner_of(port), policy.incoming, self._report, self.router.sendings.forget)
        self.ports[port] = KnownPort(policy, source, next(self._unused))
        _set_outgoing(port, policy)
        self._senders.clear()
        endpoint = None if isinstance(port, PeerLink) else port.endpoint
        self.router.add_port(port, is_peer=endpoint is None, endpoint=endpoint)

    def set_policy(self, port: Port, policy: Policy) -> None:
        """Change the rules of a port. Systems whose frames it may no longer send are not looked for behind it."""
        self.ports[port].policy = policy
        self.ports[port].source.gate = policy.incoming
        self._senders.clear()
        _set_outgoing(port, policy)
        self.router.forget_systems(port, lambda system: not policy.incoming.may_speak_as(system))
        self._forget_flows()

    def remove(self, port: Port) -> None:
        """Forget the port."""
        del self.ports[port]
        self._senders.clear()
        self.router.remove_port(port)

    def refresh(self, now: float) -> None:
        """Forget the flows: other ports may be the right ones now."""
        self.router.refresh(now)
        self._forget_flows()

    def route(self, frame: Frame, source: Port, now: float) -> tuple[Port, ...]:
        """The ports where the first frame of a flow goes. Remember them for the next one."""
        header = frame.header
        known = self.ports[source]
        incoming = known.policy.incoming
        refusal = incoming.check(frame, now)
        if refusal is not None:
            self._report(owner_of(source), header, refusal, now)
            return ()
        shows = source.vehicles if header.msgid in REPORTS and isinstance(source, PeerLink) else None
        if shows is not None:
            shows.note(frame, now)
        ports = self.router.route(frame, source, now)
        if isinstance(source, LocalPort) and source.endpoint.is_station:
            ports = tuple(port for port in ports if not self.ports[port].policy.is_of_person)
        if ports:
            if now >= self.router.valid_until:
                self.refresh(now)
            if len(known.flows) >= MAX_FLOWS:
                del known.flows[next(iter(known.flows))]
            gates = (incoming, *(self.ports[port].policy.outgoing for port in ports))
            is_conditional = shows is not None or not all(gate.always_passes(header) for gate in gates)
            is_local = isinstance(source, LocalPort) and any(isinstance(port, LocalPort) for port in ports)
            comes_once = not is_local and self._has_one_route(header.system)
            known.flows[header] = Route(ports, comes_once, is_conditional)
        return self._pass_outgoing(frame, ports, now)

    def judge(self, frame: Frame, source: Port, route: Route, now: float) -> tuple[Port, ...]:
        """The ports of a conditional route to which the policies let this frame pass."""
        refusal = self.ports[source].policy.incoming.check(frame, now)
        if refusal is not None:
            self._report(owner_of(source), frame.header, refusal, now)
            return ()
        if frame.header.msgid in REPORTS and isinstance(source, PeerLink):
            source.vehicles.note(frame, now)
        if not route.comes_once and not self.router.sendings.is_new(frame, source, route.ports, now):
            return ()
        return self._pass_outgoing(frame, route.ports, now)

    def _pass_outgoing(self, frame: Frame, ports: tuple[Port, ...], now: float) -> tuple[Port, ...]:
        passed: list[Port] = []
        for port in ports:
            known = self.ports[port]
            refusal = known.policy.outgoing.check(frame, now, known.number)
            if refusal is None:
                passed.append(port)
            else:
                self._drops.add_refused(owner_of(port), frame.header, refusal, now, to_them=True)
        return tuple(passed)

    def _has_one_route(self, system: int) -> bool:
        """Whether no port but one may send frames of this system."""
        senders = self._senders.get(system)
        if senders is None:
            senders = sum(known.policy.incoming.may_speak_as(system) for known in self.ports.values())
            self._senders[system] = senders
        return senders == 1

    def _forget_flows(self) -> None:
        for known in self.ports.values():
            known.flows.clear()


def _set_outgoing(port: Port, policy: Policy) -> None:
    if isinstance(port, LocalPort):
        port.delivered.outgoing = policy.outgoing


def owner_of(port: Port) -> str:
    """The peer or endpoint of a port, as the configuration names it."""
    return port.name if isinstance(port, PeerLink) else port.endpoint.name
