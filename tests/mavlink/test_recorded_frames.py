"""The frames of recorded flights come out byte for byte, with the facts that pymavlink decodes."""

from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import raws
from tests.tlog import read_tlog
from uavlinkd.mavlink.frames import SplitCounters, StreamSplitter, split_datagram, split_payload


def frames_of(folder: Path, flight: str) -> list[bytes]:
    """The frames of a recorded flight, also broken ones."""
    return [record.frame for record in read_tlog(folder / f"{flight}.tlog")]


# No parser accepts these: four camera messages recorded with a checksum that fits nothing.
BROKEN = {"arducopter_sitl_flight": 0, "ardusub_dive": 4, "copter_flight_mavlink1": 0}


# pymavlink refuses these, and the daemon passes them unread: message 142 in another dialect's definition.
FOREIGN = {"arducopter_sitl_flight": 0, "ardusub_dive": 0, "copter_flight_mavlink1": 1314}


@pytest.mark.parametrize("flight", sorted(BROKEN))
def test_recorded_flight_comes_out_byte_for_byte(flight: str, shared_data: Path) -> None:
    """Every frame of a real flight comes out as it went in, by datagram, stream and envelope."""
    logged = frames_of(shared_data, flight)
    counters = SplitCounters()
    good = [raw for raw in logged if raws(split_datagram(raw, counters)) == [raw]]
    assert len(logged) - len(good) == BROKEN[flight]
    assert counters.unknown == FOREIGN[flight]

    stream = StreamSplitter()
    together = b"".join(good)
    streamed = [f.raw for i in range(0, len(together), 777) for f in stream.feed(together[i : i + 777], now=0.0)]
    assert streamed == good
    batches = [good[i : i + 9] for i in range(0, len(good), 9)]
    assert [raws(split_payload(b"".join(batch), counters)) for batch in batches] == batches


@pytest.mark.parametrize("flight", ["arducopter_sitl_flight", "copter_flight_mavlink1"])
def test_recorded_facts_are_what_pymavlink_decodes(flight: str, shared_data: Path) -> None:
    """Sender, target and command of real frames are those that a full decode gives."""
    logged = frames_of(shared_data, flight)[:6_000]
    targets = 0
    for raw in logged:
        for frame in split_datagram(raw, SplitCounters()):
            if not frame.header.is_known:
                continue
            message = mavlink.MAVLink(None).parse_char(raw)
            assert (frame.header.msgid, frame.header.system, frame.header.component) == (
                message.get_msgId(),
                message.get_srcSystem(),
                message.get_srcComponent(),
            )
            wanted = getattr(message, "target" if message.msgname == "MANUAL_CONTROL" else "target_system", 0)
            assert frame.header.target_system == wanted
            assert frame.header.target_component == getattr(message, "target_component", 0)
            targets += bool(wanted)
            if frame.header.command is not None:
                assert frame.header.command == message.command
    assert targets > 5
