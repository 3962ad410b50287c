"""The daemon's own frames: what pymavlink reads of RADIO_STATUS and STATUSTEXT, and what autopilots do by them."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import read, unpacked
from uavlinkd.mavlink.own_frames import (
    TEXT_COMPONENT,
    TXBUF_FULL,
    LinkFigures,
    Note,
    RadioStatusSource,
    StatusTextSource,
    TextSeverity,
)

GOOD = LinkFigures(is_up=True, loss_in=0.0, loss_out=0.0, round_trip_s=0.04)


def said(figures: LinkFigures) -> Any:
    return unpacked(RadioStatusSource().frame(figures))


def test_pymavlink_reads_the_values() -> None:
    """A MAVLink 2 frame whose fields pymavlink decodes to what the link measured."""
    figures = LinkFigures(
        is_up=True, loss_in=0.25, loss_out=0.1, round_trip_s=0.04, demand=0.9, receive_errors=65536 + 7
    )
    raw = RadioStatusSource().frame(figures)
    message = unpacked(raw)
    assert raw[0] == 0xFD
    assert message.to_dict() == {
        "mavpackettype": "RADIO_STATUS",
        "rssi": 190,
        "remrssi": 229,
        "txbuf": 50,
        "noise": 255,
        "remnoise": 255,
        "rxerrors": 7,
        "fixed": 0,
    }
    assert (message.get_srcSystem(), message.get_srcComponent()) == (51, 68)
    assert read(raw).header.is_known


def test_sequence_is_its_own_and_wraps() -> None:
    """Each frame has the next sequence number of a component of its own."""
    source = RadioStatusSource()
    messages = [unpacked(source.frame(GOOD)) for _ in range(257)]
    assert [message.get_seq() for message in messages] == [n % 256 for n in range(257)]


@pytest.mark.parametrize(
    ("changed", "txbuf"),
    [
        ({}, 100),
        ({"demand": 0.60}, 100),
        ({"demand": 0.61}, 92),
        ({"demand": 0.81}, 50),
        ({"demand": 1.00}, 50),
        ({"demand": 1.01}, 30),
        ({"demand": 1.26}, TXBUF_FULL),
        ({"loss_out": 0.02}, 100),
        ({"loss_out": 0.03}, 92),
        ({"loss_out": 0.10}, 50),
        ({"loss_out": 0.20}, 30),
        ({"loss_out": 0.31}, TXBUF_FULL),
        ({"loss_out": 0.10, "demand": 5.0}, TXBUF_FULL),
        ({"loss_in": 0.9}, 100),
        ({"round_trip_s": None}, 100),
    ],
)
def test_worst_figure_decides_how_fast_autopilots_send(changed: dict[str, Any], txbuf: int) -> None:
    """txbuf falls with demand and with outgoing loss, at the limits and beyond, but not with incoming loss."""
    assert said(GOOD._replace(**changed)).txbuf == txbuf


@pytest.mark.parametrize(("round_trip_s", "txbuf"), [(0.13, 100), (0.2, 92), (0.4, 50), (0.9, 30), (1.5, TXBUF_FULL)])
def test_full_buffers_along_the_path_slow_autopilots_down(round_trip_s: float, txbuf: int) -> None:
    """A round trip that grows beyond its best is time spent in buffers."""
    source = RadioStatusSource()
    source.frame(GOOD)
    assert unpacked(source.frame(GOOD._replace(round_trip_s=round_trip_s))).txbuf == txbuf


def test_long_path_does_not_look_like_a_full_buffer_indefinitely() -> None:
    """A satellite's 700 ms do not count as congestion, at the start or some minutes after the path has changed."""
    slow = GOOD._replace(round_trip_s=0.7)
    assert said(slow).txbuf == 100
    source = RadioStatusSource()
    source.frame(GOOD)
    assert unpacked(source.frame(slow)).txbuf == 30
    assert unpacked([source.frame(slow) for _ in range(240)][-1]).txbuf == 100


def test_lost_peer_is_said_to_be_lost() -> None:
    """A lost peer has no signal in either direction, so failsafes that watch remrssi see it. The rate stays."""
    message = said(GOOD._replace(is_up=False, demand=3.0))
    assert (message.rssi, message.remrssi, message.txbuf) == (0, 0, 50)


@pytest.mark.parametrize(("loss", "rssi"), [(-0.5, 254), (0.0, 254), (0.999, 1), (1.0, 1), (7.0, 1)])
def test_peer_that_is_up_has_a_signal(loss: float, rssi: int) -> None:
    """Signal is 1 to 254 while the peer is up, whatever the figures: 0 means lost, 255 unknown."""
    message = said(GOOD._replace(loss_in=loss, loss_out=loss))
    assert (message.rssi, message.remrssi) == (rssi, rssi)


# STATUSTEXT.


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("link to drone1 lost", "link to drone1 lost"),
        ("x" * 50, "x" * 50),
        ("x" * 51, "x" * 50),
        ("dróne", "dr?ne"),
        ("", ""),
    ],
)
def test_pymavlink_reads_the_text(text: str, shown: str) -> None:
    """Text, severity and sender; a longer text is cut, and it is ASCII."""
    raw = StatusTextSource().frame(Note(TextSeverity.CRITICAL, text, 7))
    message = unpacked(raw)
    assert (message.get_type(), message.text, message.severity) == (
        "STATUSTEXT",
        shown,
        mavlink.MAV_SEVERITY_CRITICAL,
    )
    assert (message.id, message.chunk_seq) == (0, 0)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, mavlink.MAV_COMP_ID_UDP_BRIDGE)
    assert TEXT_COMPONENT == mavlink.MAV_COMP_ID_UDP_BRIDGE
    assert all(severity == getattr(mavlink, f"MAV_SEVERITY_{severity.name}") for severity in TextSeverity)
    assert read(raw).header.is_known


def test_each_vehicle_has_a_sequence() -> None:
    """A ground station counts lost messages by sender: numbers of one system have no gaps."""
    source = StatusTextSource()
    notes = [Note(TextSeverity.NOTICE, "text", system) for system in (1, 2) * 300]
    messages = [unpacked(source.frame(note)) for note in notes]
    for system in (1, 2):
        numbers = [message.get_seq() for message in messages if message.get_srcSystem() == system]
        assert numbers == [number % 256 for number in range(300)]
