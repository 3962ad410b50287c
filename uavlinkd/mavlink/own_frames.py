"""The daemon's own frames: RADIO_STATUS for a local autopilot, and STATUSTEXT for a local ground station.

*RADIO_STATUS* has the daemon's measurements of the link. An autopilot sends as fast as its own port accepts, and
knows nothing of the radio behind it. Radios therefore insert RADIO_STATUS once a second, and autopilots slow down by
it. How receivers read it, by their sources:

* ArduPilot (libraries/GCS_MAVLink/GCS_Common.cpp, ``handle_radio_status``): ``txbuf``, free space in the
  transmitter's buffer in percent. Under 20 each message adds 60 ms to the interval of its streams, under 50 it
  adds 20 ms, up to 2 s; over 90 it subtracts 20 ms, over 95 it subtracts 40 ms. Parameter lists and file
  transfer pause at 33 and under (50 in older releases). ``rssi`` / 254 is the radio's signal; 255 is unknown.
  ``remrssi``: a value other than 0 means that the ground receives the vehicle. A plane with FS_GCS_ENABL = 2
  (heartbeat and REMRSSI) starts its failsafe when it stays 0 (GCS_FAILSAFE_HB_RSSI).
* PX4 (src/modules/mavlink/mavlink_main.cpp, ``update_radio_status``): under 25 each message cuts the rate by
  20 %, under 35 by 2.5 %, and parameters stop; over 50 it rises by 2.5 %. This applies where MAV_n_RADIO_CTL is on.
  The other fields are published.
* QGroundControl (Vehicle, ``_handleRadioStatus``): shows ``rssi`` and ``remrssi`` as dBm, for system 51,
  component 68 by the scale of a SiK radio (rssi / 1.9 - 127, up to 0), for others as a signed byte. It does not
  treat the message as a sign of life.

Neither autopilot looks at the sender (ArduPilot exempts the message from the check of its ground station's system id,
and does not forward it). SiK radios send as system 51, component 68 ('3', 'D'; MAV_COMP_ID_TELEMETRY_RADIO is 68),
wfb-ng as 3, 68. This daemon sends as 51, 68, because clients know it as a radio and show a scale that rises with
the signal.

The fields that this daemon sends:

=============  ==========================================================================================
field          value
=============  ==========================================================================================
``txbuf``      by the worst of demand on the budget, outgoing loss and queueing delay: see LEVELS
``rssi``       share of the peer's envelopes that arrive here, 1 .. 254; 0: the peer is lost
``remrssi``    share of our envelopes that arrive at the peer, 1 .. 254; 0: the peer is lost
``noise``      255, unknown; the same for ``remnoise``
``rxerrors``   incoming envelopes that were lost, modulo 65536
``fixed``      0: no errors are corrected
=============  ==========================================================================================

A lost peer is never hidden: rssi and remrssi are 0 from that moment. But an autopilot need not slow down then: no
frames are sent to the peer, and a slower autopilot would need up to a minute to recover when the peer is back.

*STATUSTEXT* tells the pilot about a link. QGroundControl shows a text under the vehicle that sent it, and ignores
other system ids (Vehicle, ``_mavlinkMessageReceived``; only RADIO_STATUS is exempt). So a text has the system id of
the vehicle behind the link. The component id is MAV_COMP_ID_UDP_BRIDGE: the sequence numbers of the vehicle's own
texts are not disturbed, and a pilot can tell both apart. A text is at most 50 ASCII characters: clients of MAVLink 1
know no longer ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from struct import Struct
from typing import Final, NamedTuple

from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import pack

RADIO_SYSTEM: Final = 51
RADIO_COMPONENT: Final = 68
TEXT_COMPONENT: Final = 240
TEXT_BYTES: Final = 50
UNKNOWN: Final = 255
INTERVAL_S: Final = 1.0
"""How often to send: both autopilots step by each message, made for a radio that sends one a second."""

_PAYLOAD = Struct("<HHBBBBB")  # rxerrors, fixed, rssi, remrssi, txbuf, noise, remnoise


class Level(NamedTuple):
    """The value of ``txbuf`` while no figure is above these."""

    txbuf: int
    demand: float
    queueing_s: float
    loss_out: float


LEVELS: Final = (
    Level(100, demand=0.60, queueing_s=0.10, loss_out=0.02),  # plenty of room: ArduPilot and PX4 speed up
    Level(92, demand=0.80, queueing_s=0.25, loss_out=0.05),  # some room: both speed up, ArduPilot by half as much
    Level(50, demand=1.00, queueing_s=0.50, loss_out=0.15),  # enough: neither changes its rate
    Level(30, demand=1.25, queueing_s=1.00, loss_out=0.30),  # a bit too much: both slow down a little
)
TXBUF_FULL: Final = 10  # beyond the last level: both slow down by their greatest step
TXBUF_LOST: Final = 50
_BASE_CREEP: Final = 0.01


class LinkFigures(NamedTuple):
    """The link since its last measurement. Losses are shares of envelopes; values outside 0 to 1 are clipped."""

    is_up: bool
    loss_in: float
    loss_out: float
    round_trip_s: float | None
    demand: float = 0.0
    receive_errors: int = 0


def worst(figures: Sequence[LinkFigures]) -> LinkFigures:
    """The worst figures of the links that are up, as one link. There must be at least one link."""
    up = [link for link in figures if link.is_up] or figures
    trips = [link.round_trip_s for link in up if link.round_trip_s is not None]
    return LinkFigures(
        is_up=any(link.is_up for link in figures),
        loss_in=max(link.loss_in for link in up),
        loss_out=max(link.loss_out for link in up),
        round_trip_s=max(trips, default=None),
        demand=max(link.demand for link in up),
        receive_errors=sum(link.receive_errors for link in figures),
    )


class RadioStatusSource:
    """RADIO_STATUS frames for one endpoint, with a MAVLink sequence of their own."""

    __slots__ = ("_base_round_trip_s", "_seq")

    def __init__(self) -> None:
        self._seq = 0
        self._base_round_trip_s: float | None = None

    def frame(self, figures: LinkFigures) -> bytes:
        """The next frame, MAVLink 2. Call it each INTERVAL_S."""
        queueing_s = self._queueing_s(figures.round_trip_s)
        rssi, remrssi, txbuf = 0, 0, TXBUF_LOST
        if figures.is_up:
            rssi, remrssi = _quality(figures.loss_in), _quality(figures.loss_out)
            txbuf = _txbuf(figures, queueing_s)
        payload = _PAYLOAD.pack(figures.receive_errors % 65536, 0, rssi, remrssi, txbuf, UNKNOWN, UNKNOWN)
        seq, self._seq = self._seq, self._seq + 1
        return pack(IDS["RADIO_STATUS"], payload, seq, RADIO_SYSTEM, RADIO_COMPONENT)

    def _queueing_s(self, round_trip_s: float | None) -> float:
        """How much longer a round trip is than the best one: the wait in buffers along the path.

        The best value creeps towards the measured one, so that a longer path does not look like full buffers
        indefinitely.
        """
        if round_trip_s is None:
            return 0.0
        base = self._base_round_trip_s
        if base is None or round_trip_s <= base:
            base = round_trip_s
        else:
            base += (round_trip_s - base) * _BASE_CREEP
        self._base_round_trip_s = base
        return round_trip_s - base


def _txbuf(figures: LinkFigures, queueing_s: float) -> int:
    for level in LEVELS:
        if figures.demand <= level.demand and queueing_s <= level.queueing_s and figures.loss_out <= level.loss_out:
            return level.txbuf
    return TXBUF_FULL


def _quality(loss: float) -> int:
    """1 .. 254: from a peer that is up, some envelopes arrive."""
    return max(1, round(254 * (1 - min(max(loss, 0.0), 1.0))))


class TextSeverity(IntEnum):
    """MAV_SEVERITY. A smaller value is more severe."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5


class Note(NamedTuple):
    """One text about the link to a vehicle."""

    severity: TextSeverity
    text: str
    system: int  # of the vehicle


class StatusTextSource:
    """STATUSTEXT frames for one endpoint, with a MAVLink sequence for each vehicle."""

    __slots__ = ("_sequences",)

    def __init__(self) -> None:
        self._sequences: dict[int, int] = {}

    def frame(self, note: Note) -> bytes:
        seq = self._sequences.get(note.system, 0)
        self._sequences[note.system] = seq + 1
        text = note.text.encode("ascii", "replace")[:TEXT_BYTES]
        return pack(IDS["STATUSTEXT"], bytes((note.severity,)) + text, seq, note.system, TEXT_COMPONENT)
