"""A vehicle and a ground station with a half-duplex radio of 4 kbit/s, alone or beside LTE, with default settings.

The links of two daemons with their real core and egress, in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from tests.link.two_radios import End, Network, Radio, path_of
from uavlinkd.core.constants import LINE_BYTES, NEVER
from uavlinkd.core.path import SERIAL_HOST, Path
from uavlinkd.core.path_measures import limit_at
from uavlinkd.endpoints.line_framing import LineDecoder, encode
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.link.networks import COPIES_SHARE
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.frames import Frame

AIR_BITS_S = 4_000
SHARE = 0.4
"""Of the air's rate that each end uses."""
LTE = Radio(0.03)
MODEMS = ModemSettings(air_bits_s=AIR_BITS_S, turn_around_s=0.05, queue_bytes=2_000)


class SlowRadio(Network):
    """Alpha is the vehicle. The radio is the last network; LTE is the first one, if there is one."""

    def __init__(self, *others: Radio, seed: int = 1) -> None:
        super().__init__([*others, Radio(0.0, budget_bits_s=int(SHARE * AIR_BITS_S))], seed=seed)
        self.slow = len(others)
        self.random = Random(f"slow radio {seed}").random
        self.modems = ModemLink(MODEMS, Random(f"modems {seed}"))
        self.most_queued = 0
        self._decoders = {end: LineDecoder() for end in ModemEnd}
        self._modem_at = NEVER
        self.dead: set[int] = set()
        """Networks that carry nothing."""
        for end, other in ((self.alpha, "bravo"), (self.bravo, "alpha")):
            paths = [*(path_of(number, other) for number in range(len(others))), self.line]
            budget, limit = end.budgets[self.slow], limit_at(SHARE * AIR_BITS_S)
            budget.all = Bucket(budget.bits_s, 0.0, limit + LINE_BYTES)
            budget.copies = Bucket(COPIES_SHARE * budget.bits_s, 0.0, limit + LINE_BYTES)
            end.node.facts.envelope_limits = {self.slow: limit}
            end.node.facts.set_point_to_point({self.slow: [end.peer]})
            end.link.set_paths(paths, 0.0)

    @property
    def line(self) -> Path:
        return Path(self.slow, (SERIAL_HOST, 0))

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        """Put a datagram on the air."""
        if path.socket in self.dead:
            return
        if path.socket != self.slow:
            super().transmit(sender, datagram, path)
            return
        end = ModemEnd.LEFT if sender is self.alpha else ModemEnd.RIGHT
        self.modems.write(end, encode(datagram), self.now)
        self.most_queued = max(self.most_queued, self.modems.queued(end, self.now))
        self._watch_modems()

    def _watch_modems(self) -> None:
        """Look at the modems again when something comes out of them."""
        at = self.modems.next_deadline()
        if at < self._modem_at:
            self._modem_at = at
            self.at(max(at, self.now), self._read_modems)

    def _read_modems(self) -> None:
        self._modem_at = NEVER
        for end, chunk in self.modems.advance(self.now):
            receiver = self.alpha if end is ModemEnd.LEFT else self.bravo
            for datagram in self._decoders[end].feed(chunk):
                receiver.perform(receiver.node.receive(datagram, self.line, self.now))
        self._watch_modems()


@dataclass
class Offered:
    """Frames of one kind from one end, and when each of them was delivered."""

    sender: End
    receiver: End
    make: Callable[[int], Frame]
    sent_at: dict[bytes, float] = field(default_factory=dict)

    def send(self, now: float) -> None:
        frame = self.make(len(self.sent_at))
        assert frame.raw not in self.sent_at
        self.sent_at[frame.raw] = now
        self.sender.send(frame)

    def ages(self) -> dict[bytes, float]:
        """The age of each delivered one, in order of delivery."""
        pairs = zip(self.receiver.delivered, self.receiver.delivered_at, strict=True)
        return {frame.raw: at - self.sent_at[frame.raw] for frame, at in pairs if frame.raw in self.sent_at}

    def lost(self, since: float, until: float) -> int:
        """How many of those that were sent in this time did not arrive."""
        ages = self.ages()
        return sum(since <= at < until and raw not in ages for raw, at in self.sent_at.items())


def offer(radio: SlowRadio, sender: End, interval_s: float, make: Callable[[int], Frame]) -> Offered:
    """Send a frame each so often, from a random moment on."""
    flow = Offered(sender, radio.bravo if sender is radio.alpha else radio.alpha, make)

    def tick() -> None:
        flow.send(radio.now)
        radio.at(radio.now + interval_s, tick)

    radio.at(radio.now + interval_s * radio.random(), tick)
    return flow
