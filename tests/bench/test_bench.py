"""The bench itself: it carries frames, its figures are plausible, its search is right, and it cleans up."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.bench.cable import Cable
from tests.bench.contenders import Contender, NotMeasuredError, Running, all_contenders
from tests.bench.frames import PROBE_EVERY, SYSTEM, is_probe, load_frames, probe, said_by
from tests.bench.generator import Pace, pack, send_all
from tests.bench.measure import Bench, at_rate, highest_rate
from tests.bench.run import at_work, laboratory
from tests.bench.sink import Count
from tests.bench.traffic import REPOSITORY, Flow, Traffic
from tests.namespaces import need_namespaces
from uavlinkd.lab.child_processes import end_with_parent

PLAIN_HEADERS = 28
"""Headers of IPv4 and UDP."""
CONTENDERS = {contender.name: contender for contender in all_contenders()}


def messages(data: bytes) -> list[str]:
    """The messages that pymavlink, which shares no code with the bench, reads in these bytes."""
    parsed = mavlink.MAVLink(None).parse_buffer(data) or []
    return [message.get_type() for message in parsed]


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Two hosts, which are removed afterwards."""
    need_namespaces()
    with laboratory(load_frames()) as made:
        ours = (made.cable.left.path, made.cable.right.path)
        assert all(path.exists() for path in ours)
        yield made
    assert not any(path.exists() for path in ours)


@pytest.mark.parametrize("name", ["relay-uvloop", "uavlinkd"])
def test_frames_arrive_and_figures_are_plausible(bench: Bench, name: str) -> None:
    """At 1,000 frames a second frames arrive, all on an idle machine, at plausible costs and sizes."""
    with at_work(CONTENDERS[name], bench) as running:
        values = at_rate(bench, running, 1_000, 1.0)
    figures = {key: value for key, value in values.items() if isinstance(value, int | float)}
    assert figures["sent"] == 1_000
    # While a busy machine lets a process wait, the kernel drops what exceeds its socket's buffer.
    assert 500 < figures["received"] <= 1_020, figures
    assert figures["garbage"] == 0
    assert 200 < figures["rate"] < 1_100
    for side in ("left", "right"):
        assert 1 < figures[f"cpu_{side}_us"] < 5_000
        assert 5e6 < figures[f"rss_{side}"] < 200e6
    size = load_frames().mean_bytes
    assert size / 2 < figures["wire_bytes_per_frame"] < size + PLAIN_HEADERS + 60
    latencies = values["latencies_s"]
    assert isinstance(latencies, list)
    assert 0 < len(latencies) <= 1_000 // PROBE_EVERY
    assert 0 < min(latencies) <= max(latencies) < 60


def test_contender_that_carries_nothing_is_not_measured(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is reported with its reason, and stopped."""
    monkeypatch.setattr("tests.bench.run.PATIENCE", 2)

    class Deaf(Contender):
        def start(self, cable: Cable, folder: Path) -> Running:
            process = cable.left.start(["sleep", "60"])
            pids.append(process.pid)
            return Running([process], [])

    pids: list[int] = []
    with pytest.raises(NotMeasuredError, match="carries no frame"), at_work(Deaf("deaf"), bench):
        pytest.fail("it was measured")
    assert pids
    assert not any(Path("/proc", str(pid)).exists() for pid in pids)


def test_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    """All namespaces and processes are removed; the measurements so far are kept."""
    need_namespaces()
    command = [sys.executable, "-m", "tests.bench", "--only", "relay-uvloop", "--out", str(tmp_path)]
    with subprocess.Popen(
        end_with_parent(*command), cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as run:
        assert run.stdout is not None
        said = run.stdout.readline()  # the first contender begins
        assert b"relay-uvloop" in said
        inside = list(Path("/run/netns").glob(f"uavns-{run.pid}-*"))
        assert len(inside) == 2
        run.send_signal(signal.SIGINT)
        assert run.wait(30) == 1
        assert b"interrupted" in run.stdout.read()
    assert not any(path.exists() for path in inside)
    assert (tmp_path / "records.jsonl").exists()
    assert (tmp_path / "RESULTS.md").exists()


class Leaky:
    """Traffic that arrives completely up to a rate, and above it loses what does not fit a buffer."""

    def __init__(self, capacity: float, buffer: int) -> None:
        self._capacity = capacity
        self._buffer = buffer

    def flow(self, target: tuple[str, int], rate: float, seconds: float, per_datagram: int = 1) -> Flow:
        sent, came = round(rate * seconds), round(self._capacity * seconds)
        received = min(sent, came + self._buffer)
        return Flow(sent, received, 0, 0, 0, seconds, min(sent, came), (), {})


@pytest.mark.parametrize("capacity", [0, 700, 1_999, 3_000, 26_000, 190_000])
def test_search_finds_the_highest_rate(capacity: float) -> None:
    """Within its 5 %, from below, for any capacity."""
    bench = Bench(cast(Cable, None), cast(Traffic, Leaky(capacity, 0)))
    values = highest_rate(bench, Running([], []), 1.0)
    assert isinstance(values["highest"], float | int)
    assert capacity / 1.06 <= values["highest"] <= capacity * 1.01


def test_search_is_not_deceived_by_buffers() -> None:
    """What waits in a buffer at the end of an attempt would be lost in a longer one."""
    bench = Bench(cast(Cable, None), cast(Traffic, Leaky(10_000, 1_000_000)))
    values = highest_rate(bench, Running([], []), 1.0)
    assert isinstance(values["highest"], float | int)
    assert 9_500 < values["highest"] < 11_200


def test_frames_are_genuine_and_each_twentieth_carries_the_time() -> None:
    """As pymavlink reads them, also with another system id."""
    frames = load_frames().frames
    assert len(frames) % PROBE_EVERY == 0
    assert [number for number, frame in enumerate(frames) if is_probe(frame)] == list(
        range(0, len(frames), PROBE_EVERY)
    )
    some = frames[: 10 * PROBE_EVERY]
    kinds = messages(b"".join(some))
    assert len(kinds) == len(some)
    assert "BAD_DATA" not in kinds
    assert kinds[0] == "PING"
    assert messages(b"".join(said_by(frame, 77) for frame in some)) == kinds


def test_sink_counts_frames_and_not_datagrams() -> None:
    """Any number in a datagram; frames of other systems and other bytes are counted separately."""
    count = Count(SYSTEM)
    frames = load_frames().frames
    now = time.monotonic_ns()
    count.add(b"".join(frames[1:4]), now)
    count.add(bytes(probe()), 5_000)  # said at 0
    count.add(said_by(frames[1], 9) + b"nonsense", now)
    assert (count.frames, count.others, count.garbage, count.datagrams) == (4, 1, 1, 3)
    assert count.latencies_ns == [5_000]


def test_generator_keeps_its_pace() -> None:
    """As many datagrams as ordered, in their time; the time stamps rise."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as into,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        into.bind(("127.0.0.1", 0))
        into.settimeout(60)
        out.connect(into.getsockname())
        before = time.monotonic_ns()
        sent = send_all(out, pack(load_frames().frames, 2), 200, Pace(lambda number: 2_000_000 * number), 2)
        datagrams = [into.recv(2_000) for _ in range(200)]
    assert (sent.frames, sent.refused) == (400, 0)
    assert 0.39 < sent.seconds < 60
    assert sent.late_p50_s <= sent.late_p99_s <= sent.late_most_s
    assert all(len(messages(datagram)) == 2 for datagram in datagrams)
    count = Count(SYSTEM)
    for datagram in datagrams:
        count.add(datagram, 0)
    said = [-latency for latency in count.latencies_ns]
    assert len(said) == 400 // PROBE_EVERY
    assert before < said[0]
    assert all(one < next_one for one, next_one in pairwise(said))
