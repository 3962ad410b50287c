"""Local ports on UDP: who is served, who is forgotten, and what is kept out. Real sockets; the time is a literal."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.daemon.harness import frame, heartbeat, open_socket
from tests.endpoints.clients import write
from tests.waiting import until
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.endpoints.sockets import DATAGRAMS_PER_WAKE_UP, Reader, udp_socket
from uavlinkd.endpoints.udp import (
    CLIENT_IDLE_S,
    CLIENT_QUIET_S,
    CLIENTS_PER_ENDPOINT,
    LOCAL_DATAGRAM_BYTES,
    UdpServer,
)
from uavlinkd.mavlink import frames
from uavlinkd.mavlink.frames import Frame
from uavlinkd.system.stall import STALE, STALL_S, StallWatch


class Recorder:
    """What an endpoint reported."""

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.closed: list[str] = []
        self.heard: list[tuple[str, list[bytes]]] = []
        self.waited: list[float] = []
        self.epochs: list[int] = []
        self.stall = StallWatch(monotonic(), lambda seconds: None)

    def on_port_opened(self, port: LocalPort) -> None:
        """A program is there."""
        self.opened.append(port.name)

    def on_port_closed(self, port: LocalPort) -> None:
        """It is gone."""
        self.closed.append(port.name)

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """What it sent."""
        self.heard.append((port.name, [each.raw for each in frames]))
        self.waited.append(waited_s)
        self.epochs.append(epoch)


@pytest.fixture
def recorder() -> Recorder:
    """An empty one."""
    return Recorder()


@pytest.fixture
async def server(recorder: Recorder) -> AsyncIterator[UdpServer]:
    """A ``udpin`` on a free port. It reads when a test tells it to."""
    server = UdpServer("autopilot", udp_socket(Address("127.0.0.1", 0)), recorder)
    yield server
    server.close()


@pytest.fixture
def program(server: UdpServer) -> Iterator[Callable[[], socket.socket]]:
    """Makes sockets connected to the server."""
    with ExitStack() as stack:

        def make() -> socket.socket:
            sock = stack.enter_context(open_socket("127.0.0.1"))
            sock.connect(server.address)
            return sock

        yield make


Make = Callable[[], socket.socket]


def name_of(sock: socket.socket) -> str:
    """As the endpoint calls it."""
    return str(Address(*sock.getsockname()))


def read(server: UdpServer, now: float = 1.0) -> None:
    """What the loop does when the socket is readable."""
    batch = Reader(server._sock, server._count_failure, server._handler.stall).read()
    server.take(batch._replace(now=now))


async def test_what_is_there_is_handed_over_at_once(server: UdpServer, recorder: Recorder, program: Make) -> None:
    """One call for each program, with all its frames in order, however many datagrams they came in."""
    one, other = program(), program()
    one.send(frame(1))
    other.send(frame(2))
    one.send(frame(3) + frame(4))
    read(server)
    assert recorder.heard == [(name_of(one), [frame(1), frame(3), frame(4)]), (name_of(other), [frame(2)])]
    assert recorder.opened == [name_of(one), name_of(other)]
    assert server.counters.frames == 4
    assert server.bytes_received == len(frame(1) + frame(2) + frame(3) + frame(4))


async def test_the_others_have_their_turn(server: UdpServer, recorder: Recorder, program: Make) -> None:
    """A wake-up reads a bounded number of datagrams; the rest waits in the socket."""
    one = program()
    for number in range(DATAGRAMS_PER_WAKE_UP + 5):
        one.send(frame(number))
    read(server)
    read(server)
    assert [len(frames) for _, frames in recorder.heard] == [DATAGRAMS_PER_WAKE_UP, 5]


@pytest.mark.parametrize("datagram", [b"", b"hello", bytes(60000), heartbeat()[:-1], heartbeat()[:-1] + b"\x00"])
async def test_what_is_no_frame_makes_nobody_known(
    server: UdpServer, recorder: Recorder, program: Make, datagram: bytes
) -> None:
    """Only a genuine frame makes its sender a program that is sent to."""
    program().send(datagram)
    read(server)
    assert (list(server.ports), recorder.heard, recorder.opened) == ([], [], [])
    assert server.counters.garbage_bytes == len(datagram) == server.bytes_received


async def test_a_bridge_may_cut_frames_apart(server: UdpServer, recorder: Recorder, program: Make) -> None:
    """Bytes of a serial line, 24 a datagram: once a whole frame made the sender known, and few are lost, all come."""
    bridge, other = program(), program()
    sent = [heartbeat(), *(frame(number) for number in range(50))]
    stream = b"".join(sent)
    for position in range(0, len(stream), 24):
        bridge.send(stream[position : position + 24])
        other.send(frame(1000 + position))
        read(server)
    heard = [raw for name, frames in recorder.heard if name == name_of(bridge) for raw in frames]
    assert heard == [sent[0], *sent[len(sent) + 1 - len(heard) :]]
    assert len(heard) >= len(sent) - 3
    whole = sum(len(frames) for name, frames in recorder.heard if name == name_of(other))
    assert whole == -(-len(stream) // 24)
    carried = sum(len(raw) for _, frames in recorder.heard for raw in frames)
    assert carried + server.counters.garbage_bytes == server.bytes_received


async def test_who_cuts_frames_apart_is_forgotten_too(server: UdpServer, program: Make) -> None:
    """With the program goes what was held of its frames; what is no frame's beginning is not held at all."""
    bridge = program()
    for datagram in (heartbeat(), b"no frame", frame(1)[:20]):
        bridge.send(datagram)
        read(server)
    assert list(server._cutters) == list(server._ports)
    server.do_housekeeping(2.0 + CLIENT_IDLE_S)
    assert (server._cutters, server._ports) == ({}, {})


@pytest.mark.parametrize("start", [b"\xfd\x00\x00", b"\xfe\x00", b"\xfe\xff"])
async def test_false_starts_in_what_a_bridge_sends_cost_a_bounded_time(
    server: UdpServer, program: Make, start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a datagram full of them only the first are looked at, as of any other."""
    bridge = program()
    for datagram in (heartbeat(), frame(1)[:20], frame(1)[20:]):
        bridge.send(datagram)
        read(server)
    assert server._cutters
    genuine, looked_at = frames._frame_at, 0

    def look(*arguments: Any, **options: Any) -> Any:
        nonlocal looked_at
        looked_at += 1
        return genuine(*arguments, **options)

    monkeypatch.setattr(frames, "_frame_at", look)
    for _ in range(20):
        bridge.send(start * (60000 // len(start)))
        read(server)
    assert 20 < looked_at <= 20 * (frames.MAX_FALSE_STARTS + 1)
    assert server.counters.garbage_bytes > 20 * 59000


@pytest.mark.parametrize("start", [b"\xfd\xff\x00", b"\xfe\xff", frame(7)[:1] + b"\xf0" + frame(7)[2:], b"\xfd"])
@pytest.mark.parametrize("cuts", [False, True])
async def test_a_broken_beginning_doubles_nothing_and_holds_nothing_back(
    server: UdpServer, recorder: Recorder, program: Make, start: bytes, cuts: bool
) -> None:
    """Frames behind a start that claims more than there is come once, from a bridge within a second and a half."""
    bridge = program()
    sent = [heartbeat(), frame(1), frame(2), frame(3)]
    bridge.send(sent[0])
    read(server, 1.0)
    if cuts:
        for datagram in (frame(8)[:20], frame(9)[:20], frame(9)[20:]):
            bridge.send(datagram)
            read(server, 1.0)
        recorder.heard[1:] = []
    assert bool(server._cutters) == cuts
    bridge.send(start + sent[1] + sent[2])
    read(server, 1.1)
    server.do_housekeeping(1.1 + frames.MAX_GAP_S + 1.0)
    assert [raw for _, heard in recorder.heard for raw in heard] == sent[:3]
    bridge.send(sent[3])
    read(server, 3.0)
    assert [raw for _, heard in recorder.heard for raw in heard] == sent
    assert bool(server._cutters) == cuts
    carried = server.counters.garbage_bytes + sum(map(len, sent))
    assert carried + (len(frame(9)) if cuts else 0) == server.bytes_received


async def test_frames_share_datagrams_up_to_a_size(server: UdpServer, program: Make) -> None:
    """What is sent together arrives together, in datagrams that every autopilot reads; nothing is split or lost."""
    one = program()
    one.send(heartbeat())
    read(server)
    frames = [frame(number) for number in range(100)]
    write(server, server.ports[0], frames, 1.0)
    received: list[bytes] = []
    while sum(map(len, received)) < sum(map(len, frames)):
        received.append(one.recv(65536))
    assert b"".join(received) == b"".join(frames)
    assert max(map(len, received)) <= LOCAL_DATAGRAM_BYTES
    assert len(received) == -(-len(frames) // (LOCAL_DATAGRAM_BYTES // len(frames[0])))
    assert (server.frames_sent, server.bytes_sent) == (100, len(b"".join(frames)))


@pytest.mark.parametrize(("now", "is_there"), [(100.0 + CLIENT_IDLE_S - 0.001, True), (100.0 + CLIENT_IDLE_S, False)])
async def test_idle_programs_are_forgotten(
    server: UdpServer, recorder: Recorder, program: Make, now: float, is_there: bool
) -> None:
    """Just before its time a silent program is served, after it not; one that speaks stays."""
    silent, speaking = program(), program()
    silent.send(heartbeat())
    read(server, 100.0)
    speaking.send(heartbeat())
    read(server, 101.0)
    server.do_housekeeping(now)
    assert [port.name for port in server.ports] == [*[name_of(silent)] * is_there, name_of(speaking)]
    assert recorder.closed == ([] if is_there else [name_of(silent)])


async def test_a_forgotten_program_is_not_sent_to(server: UdpServer, program: Make) -> None:
    """Frames for it go nowhere, and raise nothing; when it speaks again it is there again, with the same stream."""
    one = program()
    one.send(heartbeat())
    read(server, 100.0)
    (port,) = server.ports
    server.do_housekeeping(1000.0)
    write(server, port, [frame(1)], 1000.0)
    with pytest.raises(BlockingIOError):
        one.recv(1000)
    one.send(heartbeat())
    read(server, 1001.0)
    (again,) = server.ports
    assert again.delivered is port.delivered


async def test_a_crowd_cannot_push_out_who_is_speaking(server: UdpServer, recorder: Recorder, program: Make) -> None:
    """All places taken by programs heard lately: a newcomer gets none, and is counted."""
    for _ in range(CLIENTS_PER_ENDPOINT):
        program().send(heartbeat())
    read(server, 100.0)
    newcomer = program()
    newcomer.send(heartbeat())
    read(server, 100.0 + CLIENT_QUIET_S - 0.001)
    assert len(server.ports) == CLIENTS_PER_ENDPOINT
    assert server.failures["too_many_clients"] == 1
    assert recorder.closed == []
    assert name_of(newcomer) not in [name for name, _ in recorder.heard]


async def test_a_newcomer_takes_the_place_of_the_longest_silent(
    server: UdpServer, recorder: Recorder, program: Make
) -> None:
    """Not of the first that came: of the one that has said nothing for longest, once it was quiet long enough."""
    programs = [program() for _ in range(CLIENTS_PER_ENDPOINT)]
    for each in programs:
        each.send(heartbeat())
    read(server, 100.0)
    programs[0].send(heartbeat())
    read(server, 101.0)
    newcomer = program()
    newcomer.send(heartbeat())
    read(server, 100.0 + CLIENT_QUIET_S)
    assert recorder.closed == [name_of(programs[1])]
    assert [port.name for port in server.ports][-1] == name_of(newcomer)
    assert len(server.ports) == CLIENTS_PER_ENDPOINT


async def test_what_may_wait_is_read_in_one_wake_up(server: UdpServer, recorder: Recorder, program: Make) -> None:
    """What comes after the first frame is handed over with it, and how long they waited; then it begins anew."""
    server.gather(0.2)
    server.start()
    one = program()
    for first, second in ((1, 2), (3, 4)):
        one.send(frame(first))
        await until(lambda: server._gathering is not None)
        one.send(frame(second))
        await until(lambda: server._gathering is None)
    assert [frames for _, frames in recorder.heard] == [[frame(1), frame(2)], [frame(3), frame(4)]]
    assert recorder.waited == [0.2, 0.2]


async def test_closed_while_frames_gather_nothing_is_read(recorder: Recorder) -> None:
    """The timer ends with the endpoint."""
    server = UdpServer("autopilot", udp_socket(Address("127.0.0.1", 0)), recorder)
    server.gather(0.02)
    server.start()
    with open_socket("127.0.0.1") as one:
        one.sendto(frame(1), server.address)
        await until(lambda: server._gathering is not None)
    server.close()
    await asyncio.sleep(0.05)
    assert recorder.heard == []


async def test_frames_that_waited_during_a_pause_are_stale(
    server: UdpServer, recorder: Recorder, program: Make
) -> None:
    """They are handed over as such, so that they are counted."""
    one = program()
    reader = Reader(server._sock, server._count_failure, recorder.stall)
    one.send(frame(1))
    recorder.stall.turn(monotonic() + 2 * STALL_S)
    server.take(reader.read())
    one.send(frame(2))
    server.take(reader.read())
    assert recorder.heard == [(name_of(one), [frame(1)]), (name_of(one), [frame(2)])]
    assert recorder.epochs == [STALE, 1]


async def test_frame_that_a_bridge_began_before_a_pause_is_stale(
    server: UdpServer, recorder: Recorder, program: Make
) -> None:
    """The rest of it comes after the pause; the next frame is new."""
    one = program()
    reader = Reader(server._sock, server._count_failure, recorder.stall)
    cut = frame(2)
    for datagram in (frame(1), frame(1) + cut[:10]):
        one.send(datagram)
        server.take(reader.read())
    recorder.stall.turn(monotonic() + 2 * STALL_S)
    for datagram in (cut[10:], frame(3)):
        one.send(datagram)
        server.take(reader.read())
    assert [frames for _, frames in recorder.heard] == [[frame(1)], [frame(1)], [cut], [frame(3)]]
    assert recorder.epochs == [0, 0, STALE, 1]
