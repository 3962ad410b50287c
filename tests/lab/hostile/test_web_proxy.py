"""A hostile proxy between a member's stream and a relay's: what passes, and what each of its own attacks costs."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from time import monotonic

import pytest

from tests.tls.web_streams import Loopback, Owner
from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from tests.waiting import until
from uavlinkd.lab.hostile.web_proxy import FORWARDED, SPOKEN, WEB_ATTACKS, WebContext, WebProxy
from uavlinkd.lab.mitm.attack import AttackContext
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.protocol.relay_records import wrap

REASONS = {
    "web-garbage": {"protocol"},
    "web-fragment": {"fragment"},
    "web-pings": {"pings"},
    "web-reset": {"ECONNRESET"},
}
"""Why the end that gets it loses its connection; the other one loses it because the proxy has closed it."""
SPOKEN_ONE, FORWARDED_ONE = b"\x40 an envelope", wrap(7, b"\x41 an envelope")


class Middle:
    """Passes all datagrams on, as a man in the middle without an attack."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, bytes]] = []
        self.ends: list[int] = []
        self._socks = {(end, path): _udp() for end in (0, 1) for path in (FORWARDED, SPOKEN)}
        self.ports = tuple(
            {path: self._socks[end, path].getsockname()[1] for path in (FORWARDED, SPOKEN)} for end in (0, 1)
        )
        for (end, path), sock in self._socks.items():
            asyncio.get_running_loop().add_reader(sock, self._pass, end, path, sock)

    def _pass(self, end: int, path: int, sock: socket.socket) -> None:
        datagram = sock.recv(65536)
        self.seen.append((path, datagram))
        self._socks[1 - end, path].sendto(datagram, ("127.0.0.1", self.ends[1 - end]))

    def close(self) -> None:
        for sock in self._socks.values():
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()


def _udp() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    return sock


@asynccontextmanager
async def proxied(folder: Path) -> AsyncIterator[tuple[WebProxy, Middle, Owner, Owner]]:
    """A proxy, what is inside it, a member and a relay."""
    loopback, middle, port = Loopback(folder), Middle(), free_port()
    web = WebProxy(port, loopback.port, (middle.ports[0], middle.ports[1]))
    middle.ends = [end.udp.getsockname()[1] for end in (web.to_member, web.to_relay)]
    write_tls_files(folder)
    web.start(str(folder / CERTIFICATE), str(folder / TLS_KEY))
    sock = socket.socket()
    sock.setblocking(False)
    try:
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port))
        member, relay = loopback.member(sock), loopback.relay(await loopback.accepted())
        await until(lambda: bool(member.opened and relay.opened))
        yield web, middle, member, relay
    finally:
        await web.stop()
        middle.close()
        loopback.close()


async def test_messages_pass_in_both_directions(tmp_path: Path) -> None:
    """What the relay forwards has a path of its own in the middle, and lost its header there."""
    async with proxied(tmp_path) as (_, middle, member, relay):
        for sender, receiver in ((member, relay), (relay, member)):
            await _arrives(sender, receiver, SPOKEN_ONE)
            await _arrives(sender, receiver, FORWARDED_ONE)
        assert set(middle.seen) == {(SPOKEN, SPOKEN_ONE), (FORWARDED, FORWARDED_ONE[3:])}


async def _arrives(sender: Owner, receiver: Owner, datagram: bytes) -> None:
    """The first ones may be lost while the proxy connects."""
    while datagram not in receiver.datagrams:
        sender.stream.send(datagram)
        with suppress(TimeoutError):
            async with asyncio.timeout(0.1):
                await until(lambda: datagram in receiver.datagrams)


@pytest.mark.parametrize("to", ["member", "relay"])
@pytest.mark.parametrize("name", WEB_ATTACKS)
async def test_each_attack_costs_the_connection(tmp_path: Path, name: str, to: str) -> None:
    """And nothing is delivered but what the other end sent."""
    async with proxied(tmp_path) as (web, _, member, relay):
        await _arrives(member, relay, SPOKEN_ONE)
        await _arrives(relay, member, SPOKEN_ONE)
        directions = AttackContext.between("member", "relay").directions
        context = WebContext(directions, proxy=web, member="member")
        sender = "relay" if to == "member" else "member"
        attack = parse_attack(f"{name},direction={sender}>{to}", {**WEB_ATTACKS}).make(context, 1, monotonic())
        assert len(attack.due(monotonic())) == 1
        victim = member if to == "member" else relay
        await until(lambda: bool(member.reasons and relay.reasons))
        assert victim.reasons[0] in REASONS[name]
        assert set(member.datagrams + relay.datagrams) == {SPOKEN_ONE}
        assert attack.due(monotonic() + 9) == [], "there is no connection"


def test_each_attack_has_an_expected_reason() -> None:
    """A new one needs one."""
    assert set(REASONS) == set(WEB_ATTACKS)
