"""The switch: consumes frames of a port, asks policy and router, and sends them to the ports where they belong.

A port is a local client or a peer. The switch works in batches: the frames that arrived in one wake-up leave in one
call per port. It remembers a flow: the ports where all frames of a source with one header go. So a frame of a known
flow costs a look-up. Where a frame can arrive again, it costs the check whether it is new too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import NamedTuple

from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.link.journal import DaemonJournal, ShellReason
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.routing import Router
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report
from uavlinkd.system.stall import STALL_S, StallWatch

MAX_FLOWS = 2048
"""Flows of one source that are remembered."""

Port = LocalPort | PeerLink


class Route(NamedTuple):
    """Where the frames of one source with one header go."""

    ports: tuple[Port, ...]
    comes_once: bool
    """No other port may send frames of this system, and none goes from one local client to another: all are new."""
    is_conditional: bool
    """A policy decides about each frame, by its contents or by a rate limit. Otherwise all of them pass."""


@dataclass(slots=True, eq=False)
class _Known:
    """What the switch knows of a port."""

    policy: Policy
    source: Source
    number: int
    """What a policy's rate limits know it by. A number is never used again."""
    flows: dict[Header, Route] = field(default_factory=dict)


class Switch:
    """Knows every port and its policy. It drops frames from before a pause. All times are monotonic seconds."""

    def __init__(self, router: Router[Port], stall: StallWatch, drops: DaemonJournal) -> None:
        self.router = router
        self.stall = stall
        self._drops = drops
        self._report = partial(drops.add_refused, to_them=False)
        self._ports: dict[Port, _Known] = {}
        self._unused = count()
        self._edition = -1
        """That of the router's results in the flows."""
        self._senders: dict[int, int] = {}
        """By system: how many ports may send its frames."""

    def add(self, port: Port, policy: Policy) -> None:
        """Accept frames from this port, and send frames to it, as far as its policy allows."""
        source = Source(_owner(port), policy.incoming, self._report, self.router.sendings.forget)
        self._ports[port] = _Known(policy, source, next(self._unused))
        _set_outgoing(port, policy)
        self._senders.clear()
        endpoint = None if isinstance(port, PeerLink) else port.endpoint
        self.router.add_port(port, is_peer=endpoint is None, endpoint=endpoint)

    def set_policy(self, port: Port, policy: Policy) -> None:
        """Change the rules of a port. Systems whose frames it may no longer send are not looked for behind it."""
        self._ports[port].policy = policy
        self._ports[port].source.gate = policy.incoming
        self._senders.clear()
        _set_outgoing(port, policy)
        self.router.forget_systems(port, lambda system: not policy.incoming.may_speak_as(system))
        self._forget_flows()

    def remove(self, port: Port) -> None:
        """Forget the port."""
        del self._ports[port]
        self._senders.clear()
        self.router.remove_port(port)

    def forward(self, source: Port, frames: Sequence[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Send frames of ``source`` where they belong. A frame that a policy refuses is counted and dropped.

        ``epoch``: when they were read. ``waited_s``: how long the first of them has waited for the others.
        """
        stall, at = self.stall, monotonic()
        if at - stall.turned_at > STALL_S:  # the process may have paused after it read them
            stall.turn(at)
        else:
            stall.turned_at = at
        if epoch != stall.epoch:
            stall.dropped[_owner(source)] += len(frames)
            self._drops.add("frames_dropped", ShellReason.STALE, _owner(source), len(frames), now)
            return
        router = self.router
        if now >= router.refresh_at or router.edition != self._edition:
            router.refresh(now)
            self._forget_flows()
        known = self._ports[source]
        routes = known.flows
        batches: dict[Port, list[Frame]] = {}
        for frame in frames:
            route = routes.get(frame.header)
            try:
                if route is None:
                    ports = self._route(frame, source, now)
                else:
                    ports, comes_once, is_conditional = route
                    if is_conditional:
                        ports = self._pass(frame, source, route, now)
                    elif not comes_once and not router.sendings.is_new(frame, source, ports, now):
                        continue
            except Exception as error:  # a fault costs this frame: no policy let it pass
                report(error)
                continue
            for port in ports:
                if port in batches:
                    batches[port].append(frame)
                else:
                    batches[port] = [frame]
        for port, batch in batches.items():
            try:
                port.send(batch, known.source, now, waited_s)
            except Exception as error:
                report(error)

    def _route(self, frame: Frame, source: Port, now: float) -> tuple[Port, ...]:
        """The ports where the first frame of a flow goes. Remember them for the next one."""
        header = frame.header
        known = self._ports[source]
        incoming = known.policy.incoming
        refusal = incoming.check(frame, now)
        if refusal is not None:
            self._report(_owner(source), header, refusal, now)
            return ()
        ports = self.router.route(frame, source, now)
        if ports:
            if self.router.edition != self._edition:
                self._forget_flows()
            if len(known.flows) >= MAX_FLOWS:
                del known.flows[next(iter(known.flows))]
            gates = (incoming, *(self._ports[port].policy.outgoing for port in ports))
            is_conditional = not all(gate.always_passes(header) for gate in gates)
            is_local = isinstance(source, LocalPort) and any(isinstance(port, LocalPort) for port in ports)
            comes_once = not is_local and self._has_one_route(header.system)
            known.flows[header] = Route(ports, comes_once, is_conditional)
        return self._pass_outgoing(frame, ports, now)

    def _pass(self, frame: Frame, source: Port, route: Route, now: float) -> tuple[Port, ...]:
        """The ports of a conditional route to which the policies let this frame pass."""
        refusal = self._ports[source].policy.incoming.check(frame, now)
        if refusal is not None:
            self._report(_owner(source), frame.header, refusal, now)
            return ()
        if not route.comes_once and not self.router.sendings.is_new(frame, source, route.ports, now):
            return ()
        return self._pass_outgoing(frame, route.ports, now)

    def _pass_outgoing(self, frame: Frame, ports: tuple[Port, ...], now: float) -> tuple[Port, ...]:
        passed: list[Port] = []
        for port in ports:
            known = self._ports[port]
            refusal = known.policy.outgoing.check(frame, now, known.number)
            if refusal is None:
                passed.append(port)
            else:
                self._drops.add_refused(_owner(port), frame.header, refusal, now, to_them=True)
        return tuple(passed)

    def _has_one_route(self, system: int) -> bool:
        """Whether no port but one may send frames of this system."""
        senders = self._senders.get(system)
        if senders is None:
            senders = sum(known.policy.incoming.may_speak_as(system) for known in self._ports.values())
            self._senders[system] = senders
        return senders == 1

    def _forget_flows(self) -> None:
        for known in self._ports.values():
            known.flows.clear()
        self._edition = self.router.edition


def _set_outgoing(port: Port, policy: Policy) -> None:
    if isinstance(port, LocalPort):
        port.delivered.outgoing = policy.outgoing


def _owner(port: Port) -> str:
    return port.name if isinstance(port, PeerLink) else port.endpoint.name
