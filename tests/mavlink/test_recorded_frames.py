"""The frames of recorded flights come out byte for byte, with the facts that pymavlink decodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.samples import raws
from uavlinkd.mavlink.frames import SplitCounters, split_datagram, split_payload
from uavlinkd.mavlink.stream_splitter import StreamSplitter


def entries(log: bytes) -> Iterator[bytes]:
    """The frames of a telemetry log: 8 bytes of time before each; the last may be cut."""
    position = 8
    while position + 8 <= len(log):
        if log[position] == 0xFE:
            size = 8 + log[position + 1]
        else:
            size = 12 + log[position + 1] + (13 if log[position + 2] & 1 else 0)
        yield log[position : position + size]
        position += size + 8


def pymavlink_says(raw: bytes) -> bool:
    """Whether pymavlink takes these bytes for one good frame."""
    receiver = mavlink.MAVLink(None)
    try:
        return receiver.parse_char(raw) is not None
    except mavlink.MAVError:
        return False


# No parser accepts these: four camera messages recorded with a checksum that fits nothing, and a cut end.
BROKEN = {"arducopter_sitl_flight": 0, "ardusub_dive": 4, "copter_flight_mavlink1": 1}


# pymavlink refuses these, and the daemon passes them unread: message 142 in another dialect's definition.
FOREIGN = {"arducopter_sitl_flight": 0, "ardusub_dive": 0, "copter_flight_mavlink1": 1314}


@pytest.mark.parametrize("flight", sorted(BROKEN))
def test_recorded_flight_comes_out_byte_for_byte(flight: str, shared_data: Path) -> None:
    """Every frame of a real flight comes out as it went in, by datagram, stream and envelope."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))
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


@pytest.mark.parametrize("flight", sorted(BROKEN))
def test_recorded_flight_is_what_pymavlink_counts(flight: str, shared_data: Path) -> None:
    """A frame is known exactly when pymavlink decodes it; unknown ones are those it calls bad data."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))
    sample = logged if len(logged) < 30_000 else [*logged[:2_000], *logged[-2_000:]]
    for raw in sample:
        known = [frame for frame in split_datagram(raw, SplitCounters()) if frame.header.is_known]
        assert bool(known) == pymavlink_says(raw)


@pytest.mark.parametrize("flight", ["arducopter_sitl_flight", "copter_flight_mavlink1"])
def test_recorded_facts_are_what_pymavlink_decodes(flight: str, shared_data: Path) -> None:
    """Sender, target and command of real frames are those that a full decode gives."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))[:6_000]
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
