"""The demo's bookkeeping: it can fail."""

from __future__ import annotations

import io
import json
import socket
from pathlib import Path

import pytest
from rich.console import Console

from uavlinkd.lab.sim.demo import Direction, Summary
from uavlinkd.lab.sim.demo_screen import render_summary
from uavlinkd.lab.sim.drone_process import free_udp_ports

FRAMES = [bytes((0xFD, number)) for number in range(10)]


@pytest.fixture
def way() -> Direction:
    """A direction in the measured time, with ten frames sent."""
    way = Direction(counting=True)
    for frame in FRAMES:
        way.on_sent(frame)
    return way


def test_what_arrives_as_sent_is_delivered(way: Direction) -> None:
    """All of it, in any order."""
    for frame in reversed(FRAMES):
        way.on_received(frame)
    assert (way.sent, way.delivered, way.altered, way.outstanding) == (10, 10, 0, 0)


def test_a_lost_frame_stays_outstanding(way: Direction) -> None:
    """It is no other's place."""
    for frame in FRAMES[1:]:
        way.on_received(frame)
    assert (way.delivered, way.outstanding, way.altered) == (9, 1, 0)


def test_an_altered_frame_is_no_delivery(way: Direction) -> None:
    """One bit is enough."""
    way.on_received(bytes((FRAMES[0][0], FRAMES[0][1] ^ 0x80)))
    assert (way.delivered, way.altered, way.outstanding) == (0, 1, 10)


def test_a_second_copy_is_altered_traffic(way: Direction) -> None:
    """A frame that arrives twice was sent once: somebody made the other one."""
    way.on_received(FRAMES[0])
    way.on_received(FRAMES[0])
    assert (way.delivered, way.altered) == (1, 1)


def test_the_same_frame_sent_twice_may_arrive_twice() -> None:
    """Equal frames are counted, not only known."""
    way = Direction(counting=True)
    for _ in range(2):
        way.on_sent(FRAMES[0])
    for _ in range(2):
        way.on_received(FRAMES[0])
    assert (way.sent, way.delivered, way.altered) == (2, 2, 0)


def test_frames_outside_the_measured_time_do_not_count() -> None:
    """They may arrive or not; one that was never sent is altered even then."""
    way = Direction()
    way.on_sent(FRAMES[0])
    way.on_received(FRAMES[0])
    way.on_sent(FRAMES[1])
    assert (way.sent, way.delivered, way.altered, way.outstanding) == (0, 0, 0, 0)
    way.on_received(FRAMES[2])
    assert way.altered == 1


def summary(sent: int = 10, delivered: int = 10, altered: int = 0) -> Summary:
    """What a demo came to."""
    return Summary(2.0, sent, delivered, altered, 3, {"bad_tag": 4}, 0.25)


@pytest.mark.parametrize(
    ("result", "is_perfect"),
    [
        (summary(), True),
        (summary(delivered=9), False),
        (summary(delivered=11), False),
        (summary(altered=1), False),
        (summary(sent=0, delivered=0), False),
    ],
)
def test_perfect_means_every_frame_unaltered(result: Summary, is_perfect: bool) -> None:
    """Nothing lost, nothing added, nothing altered, and not nothing at all."""
    assert result.is_perfect == is_perfect


def test_the_summary_is_one_line_of_json() -> None:
    """With the names that others rely on."""
    line = summary().to_json()
    assert "\n" not in line
    assert json.loads(line) == {
        "seconds": 2.0,
        "frames_sent": 10,
        "frames_delivered": 10,
        "frames_altered": 0,
        "handshakes": 3,
        "drops": {"bad_tag": 4},
        "rtt_ms": 0.25,
    }


@pytest.mark.parametrize(
    ("result", "verdict"), [(summary(), "Every frame"), (summary(delivered=9), "Not every frame")]
)
def test_the_last_word_is_the_verdict(result: Summary, verdict: str) -> None:
    """A person sees the same as the exit status says, and what was dropped."""
    file = io.StringIO()
    Console(file=file, width=80).print(render_summary(result))
    assert f"{verdict} arrived as it was sent." in file.getvalue()
    assert "4 bad_tag" in file.getvalue()


def test_no_round_trip_is_no_number() -> None:
    """Where none was measured, none is shown."""
    file = io.StringIO()
    Console(file=file, width=80).print(render_summary(Summary(0.0, 0, 0, 0, 0, {}, None)))
    assert "round trip not measured" in file.getvalue()


def test_ports_are_free_and_never_assigned_by_the_system() -> None:
    """Another process cannot be assigned one of them before the daemon binds it."""
    ports = free_udp_ports(20)
    assert len(set(ports)) == 20
    first = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    assert max(ports) < first
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind(("127.0.0.1", port))
