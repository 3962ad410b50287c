"""The demo's bookkeeping: it can fail."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console, RenderableType

from uavlinkd.core.drops import DropReason
from uavlinkd.lab.sim.demo_attacks import AttackCourse, AttackResult
from uavlinkd.lab.sim.demo_results import LOST_AFTER_S, Drone, FrameCounts, Summary
from uavlinkd.lab.sim.demo_screen import render, render_summary

FRAMES = [bytes((0xFD, number)) for number in range(10)]


@pytest.mark.parametrize(
    ("sent", "received", "delivered", "altered"),
    [
        (FRAMES, FRAMES[::-1], 10, 0),  # in any order
        (FRAMES, FRAMES[1:], 9, 0),  # a lost frame stays outstanding
        (FRAMES, [bytes((FRAMES[0][0], FRAMES[0][1] ^ 0x80))], 0, 1),  # one bit is enough
        (FRAMES, FRAMES[:1] * 2, 1, 1),  # a second copy is a replay
        (FRAMES[:1] * 2, FRAMES[:1] * 2, 2, 0),  # equal frames are counted, not only known
    ],
)
def test_each_frame_is_delivered_altered_or_outstanding(
    sent: list[bytes], received: list[bytes], delivered: int, altered: int
) -> None:
    """A frame that was not sent as often as it arrives is altered traffic."""
    flow = FrameCounts(counting=True)
    for frame in sent:
        flow.on_sent(frame)
    for frame in received:
        flow.on_received(frame)
    assert (flow.sent, flow.delivered, flow.altered) == (len(sent), delivered, altered)
    assert flow.outstanding == len(sent) - delivered


def test_frames_outside_the_measured_time_do_not_count() -> None:
    """They may arrive or not; one that was never sent is altered even then."""
    flow = FrameCounts()
    flow.on_sent(FRAMES[0])
    flow.on_received(FRAMES[0])
    flow.on_sent(FRAMES[1])
    assert (flow.sent, flow.delivered, flow.altered, flow.outstanding) == (0, 0, 0, 0)
    flow.on_received(FRAMES[2])
    assert flow.altered == 1


def test_a_frame_that_does_not_arrive_in_time_is_lost() -> None:
    """The attacker dropped it: it is not in flight indefinitely. If it arrives late, it is delivered."""
    clock = [0.0]
    flow = FrameCounts(now=lambda: clock[0], counting=True)
    for frame in (FRAMES[0], FRAMES[1], FRAMES[1]):  # one frame is sent twice
        flow.on_sent(frame)
    flow.on_received(FRAMES[1])
    clock[0] = LOST_AFTER_S - 0.1
    flow.on_sent(FRAMES[1])
    assert (flow.in_flight, flow.lost, flow.outstanding) == (3, 0, 3)
    clock[0] = LOST_AFTER_S
    assert (flow.in_flight, flow.lost, flow.outstanding) == (1, 2, 3)
    flow.on_received(FRAMES[0])
    assert (flow.in_flight, flow.lost, flow.delivered) == (1, 1, 2)
    clock[0] = 2 * LOST_AFTER_S
    assert (flow.in_flight, flow.lost) == (0, 2)


def drone(folder: Path, name: str, **drops: int) -> Drone:
    """A drone under attack, as its daemon answers."""
    made = Drone(name, folder / name, 65535, 65534)
    made.status = status(drops)
    return made


def status(drops: dict[str, int]) -> dict[str, Any]:
    """The status of a daemon with drops of its only peer."""
    session = {"suite": "ffdhe2048", "mode": "authenticated", "tag_bits": 128, "generation": 1234}
    refused: dict[str, Any] = {"in": {}, "out": {}}
    peer = {
        "state": "up",
        "session": session,
        "round_trip_s": 12.34567,
        "handshake_s": 123.4,
        "refused": refused,
        "envelopes_sent": 1234567,
        "envelopes_received": 1234567,
        "drops": drops,
    }
    return {"stale": {}, "send_failures": {}, "drops": {}, "endpoints": {}, "peers": {"other": peer}}


def test_drops_before_the_measured_time_do_not_count(tmp_path: Path) -> None:
    """An autopilot sends before the link is up. These frames are not counted as sent either."""
    one = drone(tmp_path, "drone0", no_session=7)
    assert one.drops == {"no_session": 7}
    one.begin()
    assert one.drops == {}
    one.status = status({"no_session": 7, "bad_tag": 2})
    assert one.drops == {"bad_tag": 2}


@pytest.mark.parametrize("attacked", [False, True])
def test_the_screen_fits_a_small_terminal(tmp_path: Path, attacked: bool) -> None:
    """80 columns and 24 lines, also when every counter has grown: rich cuts off the lines below."""
    drops = {reason.value: 12345 for reason in DropReason}
    drones = drone(tmp_path, "drone0", **drops), drone(tmp_path, "drone1", **drops)
    counts = FrameCounts(sent=1234567, delivered=1234567)
    course = None
    if attacked:
        course = AttackCourse("all")
        longest = max((str(spec) for spec in course.specs), key=len)
        course.results().extend(AttackResult(longest, 123456, drops) for _ in range(9))
    lines = printed(render(drones, (counts, counts), 123.4, course))
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert "123.4 s left" in lines[-1], "nothing is cut off"
    for text in ("link", "1,234,567", "dropped", "lost", *([longest, "123,456"] if attacked else [])):
        assert any(text in line for line in lines), text


def printed(what: RenderableType) -> list[str]:
    """The lines on a terminal of 80 columns."""
    file = io.StringIO()
    Console(file=file, width=80).print(what)
    return file.getvalue().splitlines()


def summary(sent: int = 10, delivered: int = 10, altered: int = 0) -> Summary:
    """A summary of a demo."""
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
    """No frame is lost, added or altered, and there is at least one frame."""
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
    ("result", "verdict"),
    [(summary(), "Every frame arrived unaltered"), (summary(delivered=9), "Some frames did not arrive")],
)
def test_the_last_word_is_the_verdict(result: Summary, verdict: str) -> None:
    """The text agrees with the exit status, and has the dropped datagrams."""
    file = io.StringIO()
    Console(file=file, width=80).print(render_summary(result))
    assert verdict in file.getvalue()
    assert "4 bad_tag" in file.getvalue()


def test_idle_attacks_with_commas_remain_apart() -> None:
    """Their options have commas too."""
    idle = [AttackResult(name, 0, {}) for name in ("drop,share=0.5", "hold,share=0.5,hold_s=0.5")]
    result = Summary(2.0, 10, 9, 0, 3, {}, 0.25, idle)
    assert "drop,share=0.5; hold,share=0.5,hold_s=0.5." in " ".join(" ".join(printed(render_summary(result))).split())


def test_missing_round_trip_is_not_a_number() -> None:
    """Without a measurement, the text says so."""
    file = io.StringIO()
    Console(file=file, width=80).print(render_summary(Summary(0.0, 0, 0, 0, 0, {}, None)))
    assert "round trip not measured" in file.getvalue()


def test_one_handshake_is_not_several() -> None:
    """The first one was before the traffic."""
    file = io.StringIO()
    Console(file=file, width=80).print(render_summary(Summary(2.0, 10, 10, 0, 1, {}, 0.25)))
    assert "1 handshake " in file.getvalue()
