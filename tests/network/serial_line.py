"""A serial line with two modems in the simulated network: a slow point-to-point path that alters and loses bytes.

A datagram first crosses the modems. What their line delivers undamaged then crosses the radio of its hop, so that all
that befalls other paths befalls this one too: cuts, stalls, losses. A stall is a modem that holds everything back.
"""

from __future__ import annotations

from collections.abc import Mapping
from random import Random

from tests.network.air import Address, Endpoint
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.serial.line_framing import LineDecoder, encode

SIK = ModemSettings()
BUDGET_BITS_S = 0.4 * SIK.air_bits_s
"""Of each end, as a daemon sets it."""


class SerialLine:
    """Two modems and the air between them, at a socket of one drone and at a socket of another."""

    def __init__(self, ends: Mapping[Endpoint, Address], rng: Random) -> None:
        left, right = ends
        self.addresses = dict(ends)
        """Addresses that only the network uses: a node knows the path along a line by its socket."""
        self.other = {left: right, right: left}
        self.rng = rng
        self.damaged = 0
        """Pieces that the framing dropped."""
        self._modem_ends = {left: ModemEnd.LEFT, right: ModemEnd.RIGHT}
        self._endpoints = {end: endpoint for endpoint, end in self._modem_ends.items()}
        self._modems = ModemLink(SIK, rng)
        self._decoders = {end: LineDecoder() for end in ModemEnd}

    @property
    def is_sound(self) -> bool:
        return self._modems.settings == SIK

    def set_modems(self, settings: ModemSettings) -> None:
        self._modems.settings = settings

    def plug(self, endpoint: Endpoint, now: float, *, is_plugged: bool) -> None:
        """Put the modem at one end in, or pull it out."""
        (self._modems.plug if is_plugged else self._modems.pull)(self._modem_ends[endpoint], now)

    def make_noise(self, count: int, now: float) -> None:
        """Random bytes appear on the lines to both hosts."""
        for end in ModemEnd:
            self._modems.inject(end, self.rng.randbytes(count), now)

    def write(self, endpoint: Endpoint, datagram: bytes, now: float) -> None:
        self._modems.write(self._modem_ends[endpoint], encode(datagram), now)

    def next_deadline(self) -> float:
        """When :meth:`read` is due."""
        return self._modems.next_deadline()

    def read(self, now: float) -> list[tuple[bytes, Address, Address]]:
        """The undamaged datagrams that have crossed the modems, with source and destination."""
        read = []
        for end, data in self._modems.advance(now):
            decoder, endpoint = self._decoders[end], self._endpoints[end]
            source, destination = self.addresses[self.other[endpoint]], self.addresses[endpoint]
            read += [(datagram, source, destination) for datagram in decoder.feed(data)]
        self.damaged = sum(decoder.line_noise for decoder in self._decoders.values())
        return read
