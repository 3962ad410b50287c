"""Daemons whose datagrams are dropped, all, those of one relay, of one port, or of one direction: what they print."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from tests.namespaces import need_namespaces, udp_socket_in
from tests.natlab.daemons import PORT
from tests.natlab.laboratory import Laboratory
from tests.processes.fleet import beat, make_relay
from tests.processes.frames import heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from uavlinkd.ops.netcheck import report

pytestmark = pytest.mark.long


@dataclass
class Scene:
    """A drone and a station that know relays, each on a public host of its own."""

    laboratory: Laboratory
    drone: DaemonProcess
    station: DaemonProcess
    relays: list[DaemonProcess]

    def drop(self, rules: Iterable[str]) -> None:
        """Drop from now on what matches one of these rules; D, S and R are the hosts of drone, station and relay."""
        hosts = {
            key: one.sockaddr[0] for key, one in zip("DSR", (self.drone, self.station, *self.relays), strict=False)
        }
        lines = "\n".join(f"{rule.format(**hosts)} drop" for rule in rules)
        chain = f"chain c {{ type filter hook forward priority filter;\n{lines}\n}}"
        self.laboratory.internet.nft(f"flush ruleset\ntable inet t {{\n{chain}\n}}")


@asynccontextmanager
async def scene(relays: int) -> AsyncIterator[Scene]:
    """The relays run, the two others do not."""
    need_namespaces("nft")
    with Laboratory() as laboratory:
        async with Stage() as stage:

            def daemon(name: str) -> DaemonProcess:
                place = laboratory.public()
                made = stage.daemon(name, [f"{place.address}:{PORT}"])
                made.launcher = place.host.launcher
                return made

            drone, station = daemon("drone"), daemon("station")
            made = [daemon(f"vps{number}") for number in range(relays)]
            for relay in made:
                make_relay(relay, drone, station)
            psk = stage.psk()
            addresses = ([], []) if relays else ([station.address], [drone.address])
            drone.add_peer(station, addresses[0], psk)
            station.add_peer(drone, addresses[1], psk)
            await stage.start(*made, linked=False)
            yield Scene(laboratory, drone, station, made)


async def said(daemon: DaemonProcess, cause: str) -> str:
    """The text of a finding, when it is there."""

    def texts(status: Status) -> list[str]:
        return [one["text"] for one in status["findings"] if one["cause"] == cause]

    return texts(await daemon.until(lambda status: bool(texts(status))))[0]


async def netcheck(daemon: DaemonProcess) -> str:
    """What netcheck prints, on one line."""
    return " ".join(" ".join(report(await daemon.ask("netcheck"))).split())


@pytest.mark.parametrize(
    ("relays", "rules", "text", "shown"),
    [
        (
            *(2, ["ip saddr {D} meta l4proto udp"]),
            "a firewall drops UDP here or there",
            "UDP vps0: does not answer no answer at 11.0.3.2:5790 UDP vps1: does not answer",
        ),
        (
            *(1, ["ip saddr {D} meta l4proto udp"]),
            "a firewall drops UDP here or there",
            "UDP vps0: does not answer no answer at 11.0.3.2:5790",
        ),
        (
            *(2, ["ip daddr {R} meta l4proto udp"]),
            "the relay vps0 does not answer at 11.0.3.2:5790: it is off, its address is wrong",
            "UDP vps0: does not answer no answer at 11.0.3.2:5790 UDP vps1: answers",
        ),
        (
            *(1, ["ip saddr {R} ip daddr {D}"]),
            "a firewall drops UDP here or there",
            "UDP vps0: does not answer",
        ),
    ],
    ids=["no UDP", "no UDP, one relay", "this relay", "the way back"],
)
async def test_what_is_blocked_at_the_start(relays: int, rules: list[str], text: str, shown: str) -> None:
    """`status` names the case, `netcheck` what does not answer."""
    async with scene(relays) as there:
        there.drop(rules)
        for member in (there.drone, there.station):
            await member.start()
        assert text in await said(there.drone, "relay_not_answering")
        assert shown in await netcheck(there.drone)
        if "saddr {D}" in rules[0]:
            assert "cannot reach the relay (UDP blocked there)" in await said(there.station, "not_bound")


def _has_received(peer: str, status: Status) -> bool:
    return bool(status["peers"][peer]["frames_received"] > 20)


DEAF = "no answer from it any more"
NOT_ARRIVING = "the peer's frames arrive, its echo replies do not: the direction from here to it is blocked"


@pytest.mark.parametrize(
    ("relays", "rule", "at_drone", "at_station"),
    [
        (
            *(1, "ip saddr {R} ip daddr {S}", ("freshness_unverified", NOT_ARRIVING)),
            ("relay_not_answering", "it did before, so it is off, or UDP to it or back is blocked"),
        ),
        (
            *(1, "ip saddr {S} ip daddr {R}", ("no_answer", f"{DEAF} through the relay vps0, which answers: it is")),
            ("relay_not_answering", "it did before, so it is off, or UDP to it or back is blocked"),
        ),
        (0, "ip saddr {D} ip daddr {S}", ("freshness_unverified", NOT_ARRIVING), ("no_answer", DEAF)),
        (
            *(1, "ip saddr {R} ip daddr {S} numgen random mod 100 < 60", ("high_loss", "% from here to it")),
            ("high_loss", "% from it to here"),
        ),
    ],
    ids=["relay to station", "station to relay", "direct", "part of it"],
)
async def test_one_direction_of_a_link_that_is_up(
    relays: int, rule: str, at_drone: tuple[str, str], at_station: tuple[str, str]
) -> None:
    """Both ends name the direction."""
    direct = ["ip saddr {D} ip daddr {S}", "ip saddr {S} ip daddr {D}"] if relays else []
    async with scene(relays) as there:
        there.drop(direct)
        clients = []
        for system, member in enumerate((there.drone, there.station), 1):
            place = member.add_endpoint("client")
            await member.start()
            socket = udp_socket_in(Path("/run/netns", member.launcher[-1]))
            clients.append((socket, heartbeat(system), place))
        for member in (there.drone, there.station):
            await member.until_linked()

        def send(_: int) -> None:
            for socket, frame, place in clients:
                socket.sendto(frame, place)

        sending = asyncio.create_task(beat(send, 0.05))
        try:
            for member, name in ((there.drone, "station"), (there.station, "drone")):
                await member.until(partial(_has_received, name))
            there.drop([*direct, rule])
            for member, (cause, text) in ((there.drone, at_drone), (there.station, at_station)):
                assert text in await said(member, cause)
        finally:
            sending.cancel()
            for socket, *_ in clients:
                socket.close()
