"""ICMP errors of sent datagrams: reported with the address, never instead of a datagram, and of bounded cost."""

from __future__ import annotations

import asyncio
import errno
import socket

from tests.io.clients import HOSTS, LOOPS, NewLoop, Recorder, address_of, frame, run_in, write
from tests.needs import need
from tests.processes.udp import open_socket
from tests.waiting import until
from uavlinkd.io.sockets import REPORTS_PER_S, ErrorReports, udp_socket
from uavlinkd.io.udp import UdpClient
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic


@HOSTS
def test_reports_are_limited_until_they_are_renewed(host: str) -> None:
    """A flood of errors costs nothing beyond the limit, and leaves no error behind."""
    need(host != "::1" or has_ipv6(), "IPv6 on loopback")
    closed = free_port()
    with udp_socket(Address(host, 0)) as sock, open_socket(host) as receiver:
        reports = ErrorReports(sock)
        taken = 0
        for _ in range(3 * REPORTS_PER_S):
            try:
                sock.sendto(b"x", (host, closed))
            except ConnectionRefusedError:
                taken += len(reports.take())
        assert REPORTS_PER_S <= taken <= 2 * REPORTS_PER_S
        assert reports.take() == []
        for _ in range(10):  # no error is left
            sock.sendto(b"y", receiver.getsockname())
        reports.renew()
        sock.sendto(b"x", (host, closed))
        ((address, number),) = reports.take()
        assert (address[:2], number) == ((host, closed), errno.ECONNREFUSED)


@LOOPS
def test_client_that_does_not_listen_is_counted(new_loop: NewLoop) -> None:
    """A ``udpout`` to a closed port counts the refusals, and sends again when a client listens."""

    async def run() -> None:
        port = free_port()
        endpoint = UdpClient("ground", Address("127.0.0.1", port), Recorder())
        endpoint.start()
        await until(lambda: bool(endpoint.ports))
        (target,) = endpoint.ports
        for number in range(REPORTS_PER_S):
            write(target, [frame(number)], monotonic())
            await asyncio.sleep(0)
        await until(lambda: endpoint.failures["ECONNREFUSED"] > 0)
        assert set(endpoint.failures) == {"ECONNREFUSED"}
        endpoint.do_housekeeping(monotonic())
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", port))
            client.setblocking(False)
            write(target, [frame(7)], monotonic())
            assert client.recv(1000) == frame(7)
            client.sendto(frame(8), address_of(endpoint))
            await until(lambda: endpoint.counters.frames == 1)
        endpoint.close()

    run_in(new_loop, run())
