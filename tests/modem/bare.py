"""MAVLink 2 signing on a bare modem: each frame goes to the serial port when the autopilot has it.

pymavlink 2.4 keeps the timestamp of a frame before it verifies the signature, and the checksum does not cover the
timestamp. One altered byte there can make it refuse all later frames of the sender as old. MAVLink's C library
verifies first, and so does :class:`CarefulCodec`.
"""

from __future__ import annotations

from random import Random
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem.offered import VEHICLE, Arrivals, Offered
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings

SIGNATURE_BYTES = 13
_KEY = bytes(range(32))


class CarefulCodec(mavlink.MAVLink):  # type: ignore[misc]  # pymavlink has no types
    """pymavlink's codec, which forgets the timestamp of a frame whose signature is wrong."""

    def check_signature(self, *arguments: Any) -> bool:
        before = dict(self.signing.stream_timestamps)
        is_valid = bool(super().check_signature(*arguments))
        if not is_valid:
            self.signing.stream_timestamps = before
        return is_valid


class BareLine:
    """Two codecs with a common key, and the modems between them. The vehicle is on the left.

    ``codec``: the class of both.
    """

    def __init__(self, modem: ModemSettings, seed: int, codec: type[Any] = CarefulCodec) -> None:
        self.link = ModemLink(modem, Random(seed))
        self.arrivals = Arrivals()
        self.now = 0.0
        self._codecs = {ModemEnd.LEFT: _keyed(codec, 1), ModemEnd.RIGHT: _keyed(codec, 2)}

    def send(self, what: Offered) -> None:
        end = ModemEnd.LEFT if what.system == VEHICLE else ModemEnd.RIGHT
        codec = self._codecs[end]
        codec.srcSystem, codec.srcComponent = what.system, 1
        frame = bytes(what.message.pack(codec))
        self.arrivals.send(frame, what, self.now)
        self.link.write(end, frame, self.now)

    def run(self, until: float) -> None:
        while (at := self.link.next_deadline()) <= until:
            self.now = max(self.now, at)
            for end, data in self.link.advance(self.now):
                self._receive(end, data)
        self.now = until

    def _receive(self, end: ModemEnd, data: bytes) -> None:
        for message in self._codecs[end].parse_buffer(data) or ():
            if message.get_type() != "BAD_DATA":
                self.arrivals.deliver(bytes(message.get_msgbuf()), self.now)


def _keyed(codec_class: type[Any], link_id: int) -> Any:
    codec = codec_class(None)
    codec.robust_parsing = True
    codec.signing.secret_key = _KEY
    codec.signing.sign_outgoing = True
    codec.signing.link_id = link_id
    codec.signing.timestamp = 1
    return codec
