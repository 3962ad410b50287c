"""Ports for daemons and clients that start later: no two processes choose the same one."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from uavlinkd.lab.sim.loopback_ports import BLOCK_PORTS, FIRST_PORT, free_port, free_ports


def test_ports_are_different_and_never_assigned_by_the_kernel() -> None:
    """Other sockets cannot get one of them before the daemon binds it."""
    result = free_ports(20)
    assert len(set(result)) == 20
    first = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    assert max(result) < first


def test_used_port_is_skipped() -> None:
    """UDP or TCP, on any address, in each turn of the block."""
    taken = free_ports(2)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tcp,
    ):
        udp.bind(("127.0.0.2", taken[0]))
        tcp.bind(("127.0.0.1", taken[1]))
        assert not {*taken} & {*free_ports(BLOCK_PORTS)}


def test_other_process_gets_other_ports() -> None:
    """The block of a living process is reserved, even where both start their search at the same place."""
    mine = free_port()
    script = (
        "from random import SystemRandom; from uavlinkd.lab.sim import loopback_ports;"
        f"SystemRandom.randrange = lambda *_: ({mine} - loopback_ports.FIRST_PORT) // loopback_ports.BLOCK_PORTS;"
        "print(loopback_ports.free_port())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    blocks = [(port - FIRST_PORT) // BLOCK_PORTS for port in (int(done.stdout), mine)]
    assert blocks[0] != blocks[1]
