"""The switch: takes frames from a port, asks policy and router, and hands them to the ports where they belong.

A port is a local program or a peer. Work is done by the batch: what came in one wake-up leaves in one call a port.
And what policy and router answer about a header is remembered, where the answer is the same for every frame with it:
then a frame costs a look-up, and the question whether it came by another way already.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Protocol

from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.frames import Frame, Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.routing import Router
from uavlinkd.link.peer_link import PeerLink

MAX_FLOWS = 2048
"""Headers of one source, of which the way is remembered."""

Port = LocalPort | PeerLink


class Refused(Protocol):
    """Hears of each frame that a policy does not let pass."""

    def __call__(self, who: str, header: Header, refusal: Refusal, now: float, *, to_them: bool) -> None:
        """``who``: the peer or endpoint that said it, or that is not to be told (``to_them``)."""


class Switch:
    """Knows every port and its policy. All times are monotonic seconds."""

    def __init__(self, router: Router[Port], refused: Refused) -> None:
        self.router = router
        self._refused = refused
        self._policies: dict[Port, Policy] = {}
        self._sources: dict[Port, Source] = {}
        self._numbers: dict[Port, int] = {}  # never used again, for what a policy remembers of each
        self._unused = count()
        self._flows: dict[Port, dict[Header, tuple[Port, ...]]] = {}
        self._edition = -1  # of the router's answers in the flows

    def add(self, port: Port, policy: Policy) -> None:
        """From now on frames may come from and go to this port, as far as the policy lets them."""
        self._policies[port] = policy
        self._sources[port] = Source(_owner(port), policy.incoming, self._report, self.router.forget_frame)
        _set_outgoing(port, policy)
        self._numbers[port] = next(self._unused)
        self._flows[port] = {}
        self.router.add_port(port, is_peer=isinstance(port, PeerLink))

    def set_policy(self, port: Port, policy: Policy) -> None:
        """Other rules for a port that is there. Whom it may not speak for any more is not looked for behind it."""
        self._policies[port] = policy
        self._sources[port].gate = policy.incoming
        _set_outgoing(port, policy)
        self.router.forget_systems(port, lambda system: not policy.incoming.may_speak_as(system))
        self._forget_flows()

    def remove(self, port: Port) -> None:
        """Forget the port."""
        del self._policies[port]
        del self._sources[port]
        del self._numbers[port]
        del self._flows[port]
        self.router.remove_port(port)

    def forward(self, source: Port, frames: Sequence[Frame], now: float, waited_s: float = 0.0) -> None:
        """Carry frames from ``source`` to where they belong. What policy refuses is counted and goes nowhere.

        ``waited_s``: how long the first of them has waited for the others.
        """
        router = self.router
        if now >= router.refresh_at or router.edition != self._edition:
            router.refresh(now)
            self._forget_flows()
        flows = self._flows[source]
        batches: dict[Port, list[Frame]] = {}
        for frame in frames:
            ports = flows.get(frame.header)
            if ports is None:
                ports = self._way_of(frame, source, now)
            elif not router.is_first(frame.raw, source, now):
                continue
            for port in ports:
                if port in batches:
                    batches[port].append(frame)
                else:
                    batches[port] = [frame]
        for port, batch in batches.items():
            port.send(batch, self._sources[source], now, waited_s)

    def _way_of(self, frame: Frame, source: Port, now: float) -> tuple[Port, ...]:
        """Where this one frame goes. Remembered for all of its header, if nothing about it depends on the frame."""
        incoming = self._policies[source].incoming
        refusal = incoming.check(frame, now)
        if refusal is not None:
            self._refused(_owner(source), frame.header, refusal, now, to_them=False)
            return ()
        routed = self.router.route(frame, source, now)
        passed: list[Port] = []
        always = bool(routed) and incoming.always_passes(frame.header)
        for port in routed:
            outgoing = self._policies[port].outgoing
            refusal = outgoing.check(frame, now, self._numbers[port])
            if refusal is not None:
                self._refused(_owner(port), frame.header, refusal, now, to_them=True)
            else:
                passed.append(port)
            always = always and outgoing.always_passes(frame.header)
        ways = tuple(passed)
        if always:
            if self.router.edition != self._edition:
                self._forget_flows()
            flows = self._flows[source]
            if len(flows) >= MAX_FLOWS:
                flows.clear()
            flows[frame.header] = ways
        return ways

    def _report(self, who: str, header: Header, refusal: Refusal, now: float) -> None:
        self._refused(who, header, refusal, now, to_them=False)

    def _forget_flows(self) -> None:
        for flows in self._flows.values():
            flows.clear()
        self._edition = self.router.edition


def _set_outgoing(port: Port, policy: Policy) -> None:
    if isinstance(port, LocalPort):
        port.delivered.outgoing = policy.outgoing


def _owner(port: Port) -> str:
    return port.name if isinstance(port, PeerLink) else port.endpoint.name
