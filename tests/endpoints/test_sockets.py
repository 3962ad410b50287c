"""UDP sockets as the daemon wants them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.harness import free_port, has_ipv6, need
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.sockets import (
    BUFFER_BYTES,
    BUSY_S,
    DATAGRAM_OVERHEAD_BYTES,
    DATAGRAMS_PER_WAKE_UP,
    PAUSE_S,
    BindError,
    Reader,
    numeric_host,
    udp_socket,
)
from uavlinkd.system.stall import STALE, STALL_S, StallWatch


def test_it_is_bound_and_does_not_block() -> None:
    """Reading an empty socket returns at once."""
    port = free_port()
    with udp_socket(Address("127.0.0.1", port)) as sock:
        assert sock.getsockname() == ("127.0.0.1", port)
        with pytest.raises(BlockingIOError):
            sock.recv(1)


def test_there_is_room_for_bursts() -> None:
    """The buffers are as large as asked for, or as the system lets them be. Linux gives twice that (socket(7))."""
    limits = {socket.SO_RCVBUF: "rmem_max", socket.SO_SNDBUF: "wmem_max"}
    with udp_socket(Address("127.0.0.1", 0)) as sock:
        for option, name in limits.items():
            limit = Path("/proc/sys/net/core", name)
            most = int(limit.read_text()) if limit.exists() else 0  # older kernels do not tell in a namespace
            assert sock.getsockopt(socket.SOL_SOCKET, option) >= 2 * min(BUFFER_BYTES, most)


def test_the_wildcard_of_ipv6_takes_no_ipv4() -> None:
    """[::]:P and 0.0.0.0:P are two sockets."""
    need(has_ipv6(), "an IPv6 loopback")
    port = free_port()
    with udp_socket(Address("::", port)), udp_socket(Address("0.0.0.0", port)):
        pass


def test_an_address_in_use_is_told() -> None:
    """One line with the address and the reason; the failed socket is closed."""
    with udp_socket(Address("127.0.0.1", 0)) as first:
        address = Address(*first.getsockname())
        with pytest.raises(BindError, match=rf"^cannot listen on {address}: Address already in use: .*another port$"):
            udp_socket(address)


def test_an_address_of_another_machine_is_told() -> None:
    """An address that this machine does not have."""
    with pytest.raises(BindError, match=r"^cannot listen on 192\.0\.2\.1:5790: "):
        udp_socket(Address("192.0.2.1", 5790))


@pytest.mark.parametrize("host", ["drone1.local", "fe80::1%no-such-if"])
def test_what_is_not_numeric_here_is_told(host: str) -> None:
    """Names are never looked up, and a zone must be an interface of this machine."""
    with pytest.raises(BindError, match=r"^cannot use "):
        udp_socket(Address(host, 5790))


@pytest.mark.parametrize(
    ("sockaddr", "host"),
    [
        (("127.0.0.1", 5790), "127.0.0.1"),
        (("2001:db8::1", 5790, 0, 0), "2001:db8::1"),
        (("fe80::1", 5790, 0, 2), "fe80::1%2"),
    ],
)
def test_a_zone_stays_with_its_address(sockaddr: tuple[str | int, ...], host: str) -> None:
    """Of a link-local address the host alone leads nowhere."""
    assert numeric_host(sockaddr) == host


class Pair:
    """A sender, and a reader of what it sends."""

    def __init__(self) -> None:
        self.receiver = udp_socket(Address("127.0.0.1", 0))
        self.sender = udp_socket(Address("127.0.0.1", 0))
        self.sender.connect(self.receiver.getsockname())
        self.failures: list[OSError] = []
        self.stall = StallWatch(monotonic(), lambda seconds: None)
        self.reader = Reader(self.receiver, self.failures.append, self.stall)

    def send(self, *datagrams: bytes) -> None:
        for datagram in datagrams:
            self.sender.send(datagram)

    def read(self) -> list[bytes]:
        """What one wake-up reads."""
        arrived = self.reader.read().arrived
        assert all(source == self.sender.getsockname() for _, source in arrived)
        return [datagram for datagram, _ in arrived]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Both on loopback."""
    pair = Pair()
    yield pair
    pair.sender.close()
    pair.receiver.close()


@pytest.mark.parametrize("datagrams", [(), (b"a",), (b"a", b"b", b"c"), (b"", b"b"), (b"a", b"", b"c")])
def test_one_wake_up_reads_all_that_is_there(pair: Pair, datagrams: tuple[bytes, ...]) -> None:
    """None, one or many; an empty one may end a wake-up, and begins the next."""
    pair.send(*datagrams)
    got = pair.read()
    assert got or not datagrams
    while more := pair.read():
        got += more
    assert got == list(datagrams)
    assert pair.failures == []


def test_one_wake_up_reads_no_more_than_its_share(pair: Pair) -> None:
    """The other sockets have their turn."""
    pair.send(*[bytes([number]) for number in range(DATAGRAMS_PER_WAKE_UP + 3)])
    assert len(pair.read()) == DATAGRAMS_PER_WAKE_UP
    assert len(pair.read()) == 3


def test_empty_datagrams_are_read_in_batches_too(monkeypatch: pytest.MonkeyPatch, pair: Pair) -> None:
    """Anybody can send them. On a busy socket they must not cost a pause each, and hold up what is behind them."""
    monkeypatch.setattr("uavlinkd.endpoints.sockets.monotonic", lambda: 100.0)
    pair.send(*[b""] * 60, b"frame", *[b""] * 60)
    assert pair.read() == [b""]
    assert pair.read() == [*[b""] * 59, b"frame", *[b""] * 60]


def test_a_failure_is_told_and_reading_goes_on(pair: Pair) -> None:
    """A connected socket hears of a refused datagram at the next read; what arrived is read all the same."""
    failures: list[OSError] = []
    reader = Reader(pair.sender, failures.append, pair.stall)
    pair.receiver.close()
    pair.sender.send(b"into the void")
    assert reader.read()[0] == []
    assert [type(each) for each in failures] == [ConnectionRefusedError]


def test_a_busy_socket_is_read_after_a_pause(monkeypatch: pytest.MonkeyPatch, pair: Pair) -> None:
    """Read again at once it lets datagrams gather; after a moment of quiet it does not."""
    now = 100.0
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        nonlocal now
        now += seconds
        pauses.append(seconds)

    monkeypatch.setattr("uavlinkd.endpoints.sockets.monotonic", lambda: now)
    monkeypatch.setattr("uavlinkd.endpoints.sockets.pause", pause)
    pair.reader.read()
    assert pauses == []
    now += BUSY_S / 2
    pair.reader.read()
    assert pauses == [PAUSE_S]
    now += 2 * BUSY_S
    pair.reader.read()
    assert pauses == [PAUSE_S]
    now += 2 * BUSY_S
    pair.send(*[b"full"] * (DATAGRAMS_PER_WAKE_UP + 1))
    assert len(pair.read()) == DATAGRAMS_PER_WAKE_UP
    assert pair.read() == [b"full"]  # more had gathered already: there is nothing to wait for
    assert pauses == [PAUSE_S]


def pause_process(pair: Pair) -> None:
    """This process stood still until now."""
    pair.stall.turn(monotonic() + 2 * STALL_S)


def test_datagrams_that_waited_during_a_pause_are_stale_however_slowly_they_are_read(
    monkeypatch: pytest.MonkeyPatch, pair: Pair
) -> None:
    """A second between two batches makes none of them new; what comes once the socket was empty is."""
    now = monotonic()
    monkeypatch.setattr("uavlinkd.endpoints.sockets.monotonic", lambda: now)
    pair.send(*[b"old"] * (3 * DATAGRAMS_PER_WAKE_UP + 1))
    now += 2 * STALL_S
    epochs = []
    for _ in range(4):
        epochs.append(pair.reader.read().epoch)
        now += 1.0
    assert epochs == [STALE] * 4
    pair.send(b"new")
    assert pair.reader.read()[::2] == ([(b"new", pair.sender.getsockname())], 1)


def test_empty_datagrams_do_not_pass_for_an_empty_socket(pair: Pair) -> None:
    """FIONREAD reports 0 for them too, and an old frame may be behind them."""
    pair.send(b"old", *[b""] * DATAGRAMS_PER_WAKE_UP, b"old")
    pause_process(pair)
    assert [pair.reader.read().epoch for _ in range(2)] == [STALE, STALE]


def test_socket_that_never_becomes_empty_is_stale_for_a_receive_buffer(pair: Pair) -> None:
    """A flood does not keep frames from being delivered for long after a pause."""
    pair.send(b"old")
    pause_process(pair)
    buffer_bytes = pair.receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    batches = 0
    while pair.reader.backlog.is_stale:
        pair.send(*[bytes(1000)] * (DATAGRAMS_PER_WAKE_UP + 1))
        pair.read()
        batches += 1
    assert batches == -(-buffer_bytes // (DATAGRAMS_PER_WAKE_UP * (1000 + DATAGRAM_OVERHEAD_BYTES)))


@pytest.mark.parametrize("size", [0, 1, 60, 300, 1200, 9000, 60000])
def test_a_full_socket_counts_as_no_more_than_its_receive_buffer(pair: Pair, size: int) -> None:
    """Otherwise the bound would end before the old datagrams do."""
    buffer_bytes = pair.receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    one = size + DATAGRAM_OVERHEAD_BYTES
    for _ in range(buffer_bytes // one + 2):
        pair.send(bytes(size))
    pause_process(pair)
    amount = 0
    while pair.reader.backlog.is_stale:
        amount += sum(len(each) + DATAGRAM_OVERHEAD_BYTES for each in pair.read())
    with pytest.raises(BlockingIOError):
        pair.receiver.recv(1)
    assert 0 < amount <= buffer_bytes + one
