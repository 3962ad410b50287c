"""What attacks on the line between two emulated modems achieve: nothing. In virtual time."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem.line_network import LineNetwork
from tests.modem.offered import STATION, VEHICLE, Arrivals, Offered, offered
from uavlinkd.core.settings import Link
from uavlinkd.lab.mitm.line_attacks import LINE_ATTACKS, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

OLDEST_S = 3.5
"""No frame is delivered later than this after it was sent: the limit after a silence (specification, section 11)."""


class Talk:
    """Numbered frames of both ends over a linked pair, checked against what was sent."""

    def __init__(self) -> None:
        self.network = LineNetwork(ModemSettings(), Link(), EgressSettings(coalesce_s=0.1), seed=1)
        self.arrivals = Arrivals()
        self._codec = mavlink.MAVLink(None)
        self._messages = offered(300, 0.5)
        self._began = 0.0
        self._checked = {self.network.alpha: 0, self.network.bravo: 0}

    def link(self) -> None:
        while not self.network.is_linked():
            self.network.run(self.network.now + 0.05)
            assert self.network.now < 30
        self._began = self.network.now

    def send(self, what: Offered) -> None:
        self._codec.srcSystem, self._codec.srcComponent = what.system, 1
        raw = bytes(what.message.pack(self._codec))
        self.arrivals.send(raw, what, self.network.now)
        end = self.network.alpha if what.system == VEHICLE else self.network.bravo
        end.send(*split_payload(raw, SplitCounters()))

    def run(self, seconds: float) -> None:
        """Both ends send for a time."""
        until = self.network.now + seconds
        while (at := self._began + self._messages[0].at) <= until:
            self.network.run(max(at, self.network.now))
            self.send(self._messages.pop(0))
        self.network.run(until)
        self.check()

    def check(self) -> None:
        """Every frame that was delivered was sent, and not delivered before."""
        for end, count in self._checked.items():
            for frame, at in zip(end.delivered[count:], end.delivered_at[count:], strict=True):
                self.arrivals.deliver(frame.raw, at)
            self._checked[end] = len(end.delivered)
        assert not self.arrivals.foreign

    def share(self, since: float) -> float:
        """The smaller share of critical frames that arrived at an end. The newest may still be on air."""
        until = self.network.now - 1
        return min(self.arrivals.share(system, since, until) for system in (VEHICLE, STATION))


@pytest.mark.parametrize("name", sorted(LINE_ATTACKS))
def test_attack_on_the_line_delivers_nothing(name: str) -> None:
    """No frame is forged, altered, repeated or late. When the attack ends, all frames arrive."""
    talk = Talk()
    talk.link()
    talk.run(5)
    interval_s = 15 if name == "line-hold" else 0.3
    attack = parse_line_attack(f"{name},interval_s={interval_s},limit=100")
    talk.network.attacker.change([attack], talk.network.now)
    talk.run(40)
    assert talk.network.interventions
    if name in ("line-forge", "line-replay"):  # these reach the core
        for end in (talk.network.alpha, talk.network.bravo):
            assert end.node.drops.total() + end.peer.traffic.drops.total() > 20
    assert max(talk.arrivals.ages_s.values()) < OLDEST_S
    talk.network.attacker.change([], talk.network.now)
    for place in ModemEnd:
        talk.network.modems.release(place, talk.network.now)
    talk.run(15)
    calm_since = talk.network.now
    talk.run(20)
    assert talk.share(calm_since) == 1.0
