"""Two daemons' peer links with the real core, the framing of lines, and two modems between them. In virtual time.

The left end is ``alpha``, the right one ``bravo``. Each has the other's line in its configuration.
"""

from __future__ import annotations

from collections import Counter
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
from uavlinkd.link.serial_networks import LineRate
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
            end.node.set_point_to_point({LINE.socket: [end.peer]})
            end.node.set_envelope_limits({LINE.socket: limit})
            end.budgets[LINE.socket].all.set_least_burst(limit + LINE_BYTES)
            end.link.set_paths([LINE], 0.0)
        self.rates = {end: LineRate(budget_bits_s, limit + LINE_BYTES, 0.0) for end in self._end_of}
        """How fast each end sends, by the round trips of its probes."""
        self._answered_at, self._unanswered = dict.fromkeys(self.rates, 0.0), Counter[End]()
        self._rates_at = 1.0

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        assert path == LINE, path
        self.modems.write(self._end_of[sender], encode(datagram), self.now)

    def run(self, until: float) -> None:
        """Let time pass, event by event."""
        ends = {ModemEnd.LEFT: self.alpha, ModemEnd.RIGHT: self.bravo}
        while (at := self._next_event()) <= until:
            self.now = max(self.now, at)
            self.attacker.due(self.now)
            if self.now >= self._rates_at:
                self._follow_rates()
            for place, data in self.modems.advance(self.now):
                self.attacker.observe(place, data)
                for datagram in self.decoders[place].feed(data):
                    ends[place].perform(ends[place].node.receive(datagram, LINE, self.now))
            for end in ends.values():
                if end.next_deadline() <= self.now:
                    end.handle_timeout(self.now)
        self.now = until

    def _follow_rates(self) -> None:
        self._rates_at = self.now + 1.0
        for end, rate in self.rates.items():
            for state in end.peer.paths.states:
                if state.round_trip_s is not None and state.answered_at > self._answered_at[end]:
                    self._answered_at[end] = state.answered_at
                    rate.add_round_trip(state.round_trip_s, state.answered_at)
            unanswered, self._unanswered[end] = self._unanswered[end], end.peer.traffic.echoes_unanswered
            if not end.peer.paths.states[0].is_off:
                rate.add_unanswered(self._unanswered[end] - unanswered, self.now)
            budget, bits_s = end.budgets[LINE.socket], rate.bits_s(self.now)
            budget.set_rate(bits_s, self.now)
            if budget.update_core(bits_s):
                end.node.set_rates({LINE.socket: budget.core_bits_s}, self.now)

    def _next_event(self) -> float:
        lines = min(self.modems.next_deadline(), self.attacker.next_deadline())
        return min(lines, self._rates_at, self.alpha.next_deadline(), self.bravo.next_deadline())

    def pull(self, end: ModemEnd) -> None:
        """Pull a modem out; its daemon notices."""
        self.modems.pull(end, self.now)
        self.decoders[end].reset()
        self._set_device(end, is_up=False)

    def plug(self, end: ModemEnd) -> None:
        self.modems.plug(end, self.now)
        self._set_device(end, is_up=True)

    def _set_device(self, end: ModemEnd, *, is_up: bool) -> None:
        node = self.alpha.node if end is ModemEnd.LEFT else self.bravo.node
        node.set_socket_state(LINE.socket, self.now, is_up=is_up)

    def is_linked(self) -> bool:
        """Whether both ends send on a session, along the line."""
        return all(end.peer.sessions.current is not None and end.peer.path is not None for end in self._end_of)
