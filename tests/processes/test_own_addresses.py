"""A station with two addresses, and a vehicle behind a firewall that only lets answers in."""

from __future__ import annotations

import socket
from contextlib import suppress

import pytest

from tests.namespaces import need_namespaces, udp_socket_in
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.two_hosts import ONLY, PORT, TwoHosts, address_of, interface_of
from tests.waiting import until

CLIENTS_PORT = 14550
FIREWALL = """
table inet firewall {
    chain input {
        type filter hook input priority 0; policy drop;
        iif lo accept
        ct state established,related accept
        icmpv6 type { nd-neighbor-solicit, nd-neighbor-advert, nd-router-advert } accept
    }
}
"""


@pytest.mark.parametrize(
    ("vehicle", "preferred", "asked"),
    [(address_of(ONLY, 1), address_of(ONLY, 2), "10.213.77.9"), ("fd00:77::1", "fd00:77::9", "fd00:77::2")],
)
async def test_answers_leave_from_the_address_that_was_asked(
    stage: Stage, vehicle: str, preferred: str, asked: str
) -> None:
    """The kernel would answer from the other address: IPv4 prefers the first one, IPv6 the last one."""
    need_namespaces("nft")
    is_ipv6 = ":" in asked
    place, wildcard = (f"[{asked}]", "[::]") if is_ipv6 else (asked, "0.0.0.0")
    async with TwoHosts(stage, (ONLY,)) as hosts:
        prefix = "64 nodad" if is_ipv6 else "24"
        hosts.ip(f"address replace {vehicle}/{prefix} dev {interface_of(ONLY)}")
        for address in sorted((preferred, asked)):
            hosts.hosts[1].ip(f"address replace {address}/{prefix} dev {interface_of(ONLY)}")
        hosts.hosts[0].nft(FIREWALL)
        for daemon in (hosts.vehicle, hosts.ground):
            daemon.config["listen"] = [f"{wildcard}:{PORT}"]
        hosts.vehicle.config["peer"][0]["addresses"] = [f"{place}:{PORT}"]
        hosts.ground.config["peer"][0]["addresses"] = []
        hosts.ground.add_endpoint("client", f"udpin:{wildcard}:{CLIENTS_PORT}")
        await hosts.start()

        with udp_socket_in(hosts.hosts[0].path, vehicle) as client:

            def is_served() -> bool:
                with suppress(BlockingIOError):
                    return bool(client.recv(2048))
                return False

            if is_ipv6:  # all hosts of the network are asked: no answer can leave from their address
                hosts.hosts[0].nft("flush ruleset")
                with hosts.hosts[0].entered():
                    scope = socket.if_nametoindex(interface_of(ONLY))
                client.sendto(frame(1, system=7), ("ff02::1", CLIENTS_PORT, 0, scope))
                await until(is_served)
                hosts.hosts[0].nft(FIREWALL)
            client.connect((asked, CLIENTS_PORT))
            client.send(frame(1, system=7))
            await until(is_served)
