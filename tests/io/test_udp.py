"""Local endpoints on UDP: which clients are served, which are forgotten, and what is kept out."""

from __future__ import annotations

import socket
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import ExitStack, closing

import pytest

from tests.io.clients import Recorder, address_of, frame, heartbeat, large_frame, recorder, write
from tests.processes.udp import open_socket
from uavlinkd.io.ports import CLIENT_SILENT_S, CLIENTS_PER_ENDPOINT, LocalPort
from uavlinkd.io.reader import Datagrams, Reader
from uavlinkd.io.sockets import udp_socket
from uavlinkd.io.udp import CLIENT_IDLE_S, UdpServer
from uavlinkd.io.udp_clients import LOCAL_DATAGRAM_BYTES, MOST_STREAMS
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.mavlink.frames import MAX_GAP_S
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALE, STALL_S


@pytest.fixture
async def server() -> AsyncIterator[UdpServer]:
    """A ``udpin`` on a free port. It reads when a test tells it to."""
    server = UdpServer("autopilot", udp_socket(Address("127.0.0.1", 0)), Recorder())
    yield server
    server.close()


@pytest.fixture
def client(server: UdpServer) -> Iterator[Callable[[], socket.socket]]:
    """Makes sockets connected to the server."""
    with ExitStack() as stack:

        def make() -> socket.socket:
            sock = stack.enter_context(open_socket("127.0.0.1"))
            sock.connect(address_of(server))
            return sock

        yield make


Make = Callable[[], socket.socket]


def name_of(sock: socket.socket) -> str:
    """Its name in the endpoint."""
    return str(Address(*sock.getsockname()))


def names(ports: Sequence[LocalPort]) -> list[str]:
    return [port.name for port in ports]


def reader_of(server: UdpServer, now: float = 1.0) -> Reader:
    """A reader whose datagrams arrive at this time."""

    def take(datagrams: Datagrams, _: float, epoch: int, waited_s: float) -> None:
        server.take(datagrams, now, epoch, waited_s)

    return Reader(server._sock, take, server._on_read_error, server.handler.stall)


def read(server: UdpServer, now: float = 1.0) -> None:
    """Read the socket as the loop does."""
    reader_of(server, now).read(monotonic())


@pytest.mark.parametrize("datagram", [b"", b"hello", bytes(60000), heartbeat()[:-1], heartbeat()[:-1] + b"\x00"])
async def test_garbage_does_not_make_its_sender_a_client(server: UdpServer, client: Make, datagram: bytes) -> None:
    """Only a genuine frame does."""
    client().send(datagram)
    read(server)
    server.do_housekeeping(2.0)
    assert (list(server.ports), recorder(server).by_client, recorder(server).open) == ([], [], [])
    assert server.counters.garbage_bytes == len(datagram) == server.bytes_received


@pytest.mark.parametrize("start", [b"\xfd\xff\x00", b"\xfe\xff", frame(7)[:1] + b"\xf0" + frame(7)[2:], b"\xfd"])
async def test_a_broken_beginning_doubles_nothing_and_holds_nothing_back(
    server: UdpServer, client: Make, start: bytes
) -> None:
    """Frames behind a false start are delivered once, within 1.5 s."""
    one = client()
    sent = [heartbeat(), frame(1), frame(2), frame(3)]
    one.send(sent[0])
    read(server, 1.0)
    one.send(start + sent[1] + sent[2])
    read(server, 1.1)
    server.do_housekeeping(1.1 + MAX_GAP_S + 1.0)
    assert recorder(server).received == sent[:3]
    one.send(sent[3])
    read(server, 3.0)
    assert recorder(server).received == sent
    assert server.counters.garbage_bytes == len(start)


BRIDGE = ("127.0.0.1", 1)


def cut(frames: Sequence[bytes], size: int) -> list[bytes]:
    """Datagrams of this size, as of a bridge from a serial line."""
    stream = b"".join(frames)
    return [stream[at : at + size] for at in range(0, len(stream), size)]


@pytest.mark.parametrize("size", [1, 6, 8, 20, 64, 300])
async def test_frames_that_a_bridge_cuts_anywhere_are_assembled_from_the_first_byte(
    server: UdpServer, size: int
) -> None:
    """Frames of 21 bytes and others: none is lost."""
    sent = [heartbeat(), *map(frame, range(20)), large_frame(1), *[heartbeat()] * 20]
    for number, datagram in enumerate(cut(sent, size)):
        server.take([(datagram, BRIDGE)], number / 1000, 0)
    assert recorder(server).received == sent
    assert server.counters.garbage_bytes == 0


@pytest.mark.parametrize("size", [8, 20, 64])
async def test_a_lost_datagram_costs_only_the_frames_in_it(server: UdpServer, size: int) -> None:
    """Every other frame is delivered once, at the latest after the next silence."""
    sent = [frame(number) for number in range(10)]
    datagrams = cut(sent, size)
    for lost in range(len(datagrams)):
        recorder(server).by_client.clear()
        for number, datagram in enumerate(datagrams):
            if number != lost:
                server.take([(datagram, BRIDGE)], 10.0 * lost, 0)
        server.do_housekeeping(10.0 * lost + 2 * MAX_GAP_S)
        touched = range(lost * size // len(sent[0]), -(-min((lost + 1) * size, 10 * len(sent[0])) // len(sent[0])))
        assert recorder(server).received == [raw for number, raw in enumerate(sent) if number not in touched]


async def test_unfinished_frames_of_strangers_are_bounded_and_displace_no_client(server: UdpServer) -> None:
    """A client's frame is finished after a flood; of the strangers, only the latest ones can finish theirs."""
    half, rest = heartbeat()[:10], heartbeat()[10:]
    strangers = [("192.0.2.1", port) for port in range(1, 1 + 2 * MOST_STREAMS)]
    server.take([(heartbeat() + half, BRIDGE)], 1.0, 0)
    server.take([(half, stranger) for stranger in strangers], 1.0, 0)
    server.take([(rest, BRIDGE), (rest, strangers[0]), (rest, strangers[-1])], 1.1, 0)
    assert recorder(server).by_client == [
        ("127.0.0.1:1", [heartbeat()]),
        ("127.0.0.1:1", [heartbeat()]),
        (f"192.0.2.1:{strangers[-1][1]}", [heartbeat()]),
    ]


async def test_frames_share_datagrams_up_to_a_size(server: UdpServer, client: Make) -> None:
    """Frames share datagrams of a size that every autopilot reads. No frame is split or lost."""
    one = client()
    one.send(heartbeat())
    read(server)
    frames = [frame(number) for number in range(100)]
    write(server.ports[0], frames, 1.0)
    received: list[bytes] = []
    while sum(map(len, received)) < sum(map(len, frames)):
        received.append(one.recv(65536))
    assert b"".join(received) == b"".join(frames)
    assert max(map(len, received)) <= LOCAL_DATAGRAM_BYTES
    assert len(received) == -(-len(frames) // (LOCAL_DATAGRAM_BYTES // len(frames[0])))
    assert (server.frames_sent, server.bytes_sent) == (100, len(b"".join(frames)))


@pytest.mark.parametrize(("now", "is_there"), [(100.0 + CLIENT_IDLE_S - 0.001, True), (100.0 + CLIENT_IDLE_S, False)])
async def test_idle_clients_are_forgotten(server: UdpServer, client: Make, now: float, is_there: bool) -> None:
    """A silent client is served until its time is over. A client that sends stays."""
    silent, speaking = client(), client()
    silent.send(heartbeat())
    read(server, 100.0)
    speaking.send(heartbeat())
    read(server, 101.0)
    server.do_housekeeping(now)
    assert names(server.ports) == [*[name_of(silent)] * is_there, name_of(speaking)]
    assert names(recorder(server).closed) == ([] if is_there else [name_of(silent)])


async def test_a_forgotten_client_is_not_sent_to(server: UdpServer, client: Make) -> None:
    """Frames for it are dropped. When it sends again, it is a client again, with the same stream."""
    one = client()
    one.send(heartbeat())
    read(server, 100.0)
    (port,) = server.ports
    server.do_housekeeping(1000.0)
    write(port, [frame(1)], 1000.0)
    with pytest.raises(BlockingIOError):
        one.recv(1000)
    one.send(heartbeat())
    read(server, 1001.0)
    (again,) = server.ports
    assert again.delivered is port.delivered


async def test_client_is_answered_from_the_own_address_that_it_asked() -> None:
    """It stays one client when it asks another one."""
    server = UdpServer("autopilot", udp_socket(Address("0.0.0.0", free_port())), Recorder())
    with closing(server), open_socket("127.0.0.1") as one:
        for number, own in enumerate(("127.0.0.2", "127.0.0.1", "127.0.0.3")):
            one.connect((own, address_of(server)[1]))  # it receives from there only
            one.send(heartbeat())
            read(server)
            write(server.ports[0], [frame(number)], 1.0)
            assert one.recv(2048) == frame(number)
            assert names(server.ports) == [name_of(one)]
        assert len(recorder(server).open) == 1


async def test_new_clients_cannot_displace_active_ones(server: UdpServer, client: Make) -> None:
    """All places are taken by clients that sent recently: a new client gets no place, and is counted."""
    for _ in range(CLIENTS_PER_ENDPOINT):
        client().send(heartbeat())
    read(server, 100.0)
    newcomer = client()
    newcomer.send(heartbeat())
    read(server, 100.0 + CLIENT_SILENT_S - 0.001)
    assert len(server.ports) == CLIENTS_PER_ENDPOINT
    assert server.failures["too_many_clients"] == 1
    assert recorder(server).closed == []
    assert name_of(newcomer) not in [name for name, _ in recorder(server).by_client]


async def test_a_new_client_displaces_the_one_that_is_silent_longest(server: UdpServer, client: Make) -> None:
    """Not the first one that connected, and only once it has been silent long enough."""
    clients = [client() for _ in range(CLIENTS_PER_ENDPOINT)]
    for sock in clients:
        sock.send(heartbeat())
    read(server, 100.0)
    clients[0].send(heartbeat())
    read(server, 101.0)
    newcomer = client()
    newcomer.send(heartbeat())
    read(server, 100.0 + CLIENT_SILENT_S)
    assert names(recorder(server).closed) == [name_of(clients[1])]
    assert names(server.ports)[-1] == name_of(newcomer)
    assert len(server.ports) == CLIENTS_PER_ENDPOINT


async def test_frame_that_a_bridge_began_before_a_pause_is_stale(server: UdpServer, client: Make) -> None:
    """The rest of it comes after the pause; the next frame is new."""
    one = client()
    reader = reader_of(server)
    broken = frame(2)
    for datagram in (frame(1), frame(1) + broken[:10]):
        one.send(datagram)
        reader.read(monotonic())
    recorder(server).stall.turn(monotonic() + 2 * STALL_S)
    for datagram in (broken[10:], frame(3)):
        one.send(datagram)
        reader.read(monotonic())
    assert [frames for _, frames in recorder(server).by_client] == [[frame(1)], [frame(1)], [broken], [frame(3)]]
    assert recorder(server).epochs == [0, 0, STALE, 1]
