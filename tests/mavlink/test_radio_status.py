"""RADIO_STATUS: what pymavlink reads, and what it makes the autopilots do."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import pytest

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.mavlink.radio_status import TXBUF_FULL, LinkFigures, RadioStatusSource

GOOD = LinkFigures(is_up=True, loss_in=0.0, loss_out=0.0, round_trip_s=0.04)


def decoded(raw: bytes) -> Any:
    (message,) = mavlink.MAVLink(None).parse_buffer(raw)
    return message


def said(figures: LinkFigures) -> Any:
    return decoded(RadioStatusSource().frame(figures))


def test_pymavlink_reads_the_values() -> None:
    """A MAVLink 2 frame whose fields pymavlink decodes to what the link measured."""
    figures = LinkFigures(
        is_up=True, loss_in=0.25, loss_out=0.1, round_trip_s=0.04, demand=0.9, receive_errors=65536 + 7
    )
    raw = RadioStatusSource().frame(figures)
    message = decoded(raw)
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
    (frame,) = split_datagram(raw, SplitCounters())
    assert frame.header.is_known


def test_sender_is_a_choice_and_the_sequence_its_own() -> None:
    """Each frame has the next sequence number, which wraps; the sender is what was asked for."""
    source = RadioStatusSource(system=3, component=69)
    messages = [decoded(source.frame(GOOD)) for _ in range(257)]
    assert [message.get_seq() for message in messages] == [n % 256 for n in range(257)]
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in messages} == {(3, 69)}


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
    assert said(replace(GOOD, **changed)).txbuf == txbuf


@pytest.mark.parametrize(("round_trip_s", "txbuf"), [(0.13, 100), (0.2, 92), (0.4, 50), (0.9, 30), (1.5, TXBUF_FULL)])
def test_full_buffers_along_the_path_slow_autopilots_down(round_trip_s: float, txbuf: int) -> None:
    """A round trip that grows beyond its best is time spent in buffers."""
    source = RadioStatusSource()
    source.frame(GOOD)
    assert decoded(source.frame(replace(GOOD, round_trip_s=round_trip_s))).txbuf == txbuf


def test_long_path_does_not_look_like_a_full_buffer_indefinitely() -> None:
    """A satellite's 700 ms do not count as congestion, at the start or some minutes after the path has changed."""
    slow = replace(GOOD, round_trip_s=0.7)
    assert said(slow).txbuf == 100
    source = RadioStatusSource()
    source.frame(GOOD)
    assert decoded(source.frame(slow)).txbuf == 30
    assert decoded([source.frame(slow) for _ in range(240)][-1]).txbuf == 100


def test_lost_peer_is_said_to_be_lost() -> None:
    """A lost peer has no signal in either direction, so failsafes that watch remrssi see it. The rate stays."""
    message = said(replace(GOOD, is_up=False, demand=3.0))
    assert (message.rssi, message.remrssi, message.txbuf) == (0, 0, 50)


@pytest.mark.parametrize(("loss", "rssi"), [(-0.5, 254), (0.0, 254), (0.999, 1), (1.0, 1), (7.0, 1)])
def test_peer_that_is_up_has_a_signal(loss: float, rssi: int) -> None:
    """Signal is 1 to 254 while the peer is up, whatever the figures: 0 means lost, 255 unknown."""
    message = said(replace(GOOD, loss_in=loss, loss_out=loss))
    assert (message.rssi, message.remrssi) == (rssi, rssi)


def test_counter_of_errors_wraps() -> None:
    """rxerrors has 16 bits and wraps, like a radio's own."""
    assert [said(replace(GOOD, receive_errors=n)).rxerrors for n in (0, 65535, 65536)] == [0, 65535, 0]
