"""The RADIO_STATUS of a modem: our own reader beside pymavlink's."""

from __future__ import annotations

from pymavlink.dialects.v20.all import MAVLink

from tests.endpoints.test_line_framing import FIGURES, report
from uavlinkd.endpoints.radio_reports import RadioReport, parse_report, report_bytes


def test_reports_of_pymavlink_are_recognised() -> None:
    """In both versions. MAVLink 2 cuts trailing zeros, so a modem's report has the full length only without."""
    figures = RadioReport(rssi=1, remrssi=2, txbuf=3, noise=4, remnoise=5, rxerrors=600, fixed=7)
    for force_mavlink1 in (True, False):
        sender = MAVLink(None, 51, 68)
        message = sender.radio_status_encode(1, 2, 3, 4, 5, 600, 7)
        frame = bytes(message.pack(sender, force_mavlink1=force_mavlink1))
        assert report_bytes(frame, 0) == len(frame)
        assert parse_report(frame) == figures


def test_figures_and_prefixes() -> None:
    """Each start of a report may become one; other bytes do not."""
    for frame in (report(), report(2), report(1, 166)):
        assert parse_report(frame) == FIGURES
        assert [report_bytes(frame[:size], 0) for size in range(1, len(frame))] == [None] * (len(frame) - 1)
        assert report_bytes(b"\x09" + frame, 1) == len(frame)
        assert report_bytes(frame[:-1] + bytes((frame[-1] ^ 1,)), 0) == 0
    assert report_bytes(b"\x09", 0) == 0
