"""Two daemons' peer links with the real core, the framing of lines, and two modems between them. In virtual time.

Unlike daemons they send at one rate, also when answers come late.

The left end is ``alpha``, the right one ``bravo``. Each has the other's line in its configuration.
"""

from __future__ import annotations

from random import Random
from typing import Final

from tests.link.two_radios import End, Network, Radio
from uavlinkd.config.network_rules import SENDING_SHARE
from uavlinkd.core.constants import LINE_BYTES
from uavlinkd.core.path import SERIAL_HOST, Path
from uavlinkd.core.path_measures import limit_at
from uavlinkd.core.settings import Link
from uavlinkd.endpoints.line_framing import LineDecoder, encode
from uavlinkd.lab.mitm.attack import Intervention
from uavlinkd.lab.mitm.line_attacks import LineAttacker
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings

LINE: Final = Path(0, (SERIAL_HOST, 0))


class LineNetwork(Network):
    """Two ends on a serial line. ``egress`` and ``link``: of both."""

    def __init__(self, modem: ModemSettings, link: Link, egress: EgressSettings, seed: int) -> None:
        self.modems = ModemLink(modem, Random(seed))
        self.decoders = {end: LineDecoder() for end in ModemEnd}
        self.interventions: list[Intervention] = []
        self.attacker = LineAttacker(self.modems, Random(seed), self.interventions.append)
        budget_bits_s = int(SENDING_SHARE * modem.air_bits_s)
        limit = limit_at(budget_bits_s)
        super().__init__([Radio(0.0, budget_bits_s=budget_bits_s)], link, {"alpha": egress, "bravo": egress}, seed)
        self._end_of = {self.alpha: ModemEnd.LEFT, self.bravo: ModemEnd.RIGHT}
        for end in (self.alpha, self.bravo):
            end.node.facts.set_point_to_point({LINE.socket: [end.peer]})
            end.node.facts.envelope_limits = {LINE.socket: limit}
            end.budgets[LINE.socket].all.set_least_burst(limit + LINE_BYTES)
            end.link.set_paths([LINE], 0.0)

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        assert path == LINE, path
        self.modems.write(self._end_of[sender], encode(datagram), self.now)

    def run(self, until: float) -> None:
        """Let time pass, event by event."""
        ends = {ModemEnd.LEFT: self.alpha, ModemEnd.RIGHT: self.bravo}
        while (at := self._next_event()) <= until:
            self.now = max(self.now, at)
            self.attacker.due(self.now)
            for place, data in self.modems.advance(self.now):
                self.attacker.observe(place, data)
                for datagram in self.decoders[place].feed(data):
                    ends[place].perform(ends[place].node.receive(datagram, LINE, self.now))
            for end in ends.values():
                if end.next_deadline() <= self.now:
                    end.handle_timeout(self.now)
        self.now = until

    def _next_event(self) -> float:
        lines = min(self.modems.next_deadline(), self.attacker.next_deadline())
        return min(lines, self.alpha.next_deadline(), self.bravo.next_deadline())

    def is_linked(self) -> bool:
        """Whether both ends send on a session, along the line."""
        return all(end.peer.sessions.current is not None and end.peer.path is not None for end in self._end_of)
