"""A man in the middle between a station and a real daemon: the attacks of the catalogue that have a meaning there."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable, Iterator
from itertools import count

import pytest

from tests import waiting
from tests.processes.frames import command_long
from tests.processes.harness import Stage
from tests.processes.udp import open_socket
from tests.stations.test_daemon import ARM, Setup
from uavlinkd.config import keys
from uavlinkd.stations import handshake

pytestmark = pytest.mark.long
ATTEMPTS = 200


class Middle:
    """Forwards datagrams between the station and the daemon, records them, and keeps the station's on request."""

    def __init__(self, daemon: tuple[str, int], daemon_key: bytes) -> None:
        self._daemon = daemon
        self._to_station, self._to_daemon = open_socket("127.0.0.1"), open_socket("127.0.0.1")
        self.address = self._to_station.getsockname()
        self.macs = handshake.Macs(daemon_key)
        self.of_station: list[bytes] = []
        self.of_daemon: list[bytes] = []
        self.kept: list[bytes] | None = None
        self.random = random.Random(1)
        loop = asyncio.get_running_loop()
        loop.add_reader(self._to_station, self._from_station)
        loop.add_reader(self._to_daemon, self._from_daemon)

    def close(self) -> None:
        for sock in (self._to_station, self._to_daemon):
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()

    def _from_station(self) -> None:
        datagram, self._station = self._to_station.recvfrom(4096)
        self.of_station.append(datagram)
        if self.kept is None:
            self.inject(datagram)
        else:
            self.kept.append(datagram)

    def _from_daemon(self) -> None:
        datagram = self._to_daemon.recv(4096)
        self.of_daemon.append(datagram)
        self._to_station.sendto(datagram, self._station)

    def inject(self, datagram: bytes) -> None:
        self._to_daemon.sendto(datagram, self._daemon)

    def pass_on(self) -> None:
        """Everything that was kept, and what comes from now on."""
        kept, self.kept = self.kept or [], None
        for datagram in kept:
            self.inject(datagram)

    def altered(self, datagram: bytes, first: int = 0) -> bytes:
        """With one byte changed."""
        data = bytearray(datagram)
        data[self.random.randrange(first, len(data))] ^= self.random.randrange(1, 256)
        return bytes(data)

    def recorded(self, kind: int) -> list[bytes]:
        """What the station sent of this kind."""
        return [datagram for datagram in self.of_station if datagram[0] == kind]


def altered_data(middle: Middle) -> Iterator[bytes]:
    """Of the packets that the daemon has not seen: those that the middle keeps."""
    return (middle.altered(datagram) for datagram in middle.kept or [] for _ in range(ATTEMPTS // 10))


def replayed_data(middle: Middle) -> Iterator[bytes]:
    return iter(middle.recorded(4)[-40:] * 5)


def data_in_reverse(middle: Middle) -> Iterator[bytes]:
    """Old ones, the newest first, with the counters of newer ones in their place."""
    newest = middle.recorded(4)[-1]
    return (datagram[:8] + newest[8:16] + datagram[16:] for datagram in middle.recorded(4)[:-1][::-1] * 5)


def reflected(middle: Middle) -> Iterator[bytes]:
    return iter((middle.of_daemon * ATTEMPTS)[:ATTEMPTS])


def replayed_initiations(middle: Middle) -> Iterator[bytes]:
    return iter((middle.recorded(1) * ATTEMPTS)[:ATTEMPTS])


def altered_initiations(middle: Middle) -> Iterator[bytes]:
    """Behind the sender's index, which no tag covers; with the right mac1."""
    (first, *_) = middle.recorded(1)
    return (middle.macs.add(middle.altered(first[:-32], 8), None) for _ in range(ATTEMPTS))


def initiations_of_low_order(middle: Middle) -> Iterator[bytes]:
    return (middle.macs.add(b"\1\0\0\0" + bytes(112), None) for _ in range(ATTEMPTS))


def responses(middle: Middle) -> Iterator[bytes]:
    """To the sessions and initiations of the daemon, with the right mac1."""
    indices = [datagram[4:8] for datagram in middle.of_daemon if datagram[0] in (1, 2)]
    for number in range(ATTEMPTS):
        message = b"\2\0\0\0\1\0\0\0" + indices[number % len(indices)] + middle.random.randbytes(48)
        yield middle.macs.add(message, None)


def cookies(middle: Middle) -> Iterator[bytes]:
    indices = [datagram[4:8] for datagram in middle.of_daemon if datagram[0] in (1, 2)]
    return (b"\3\0\0\0" + indices[n % len(indices)] + middle.random.randbytes(56) for n in range(ATTEMPTS))


ATTACKS: dict[Callable[[Middle], Iterator[bytes]], set[str]] = {
    altered_data: {"bad_tag", "unknown_index", "malformed"},
    replayed_data: {"replayed"},
    data_in_reverse: {"bad_tag", "replayed"},
    reflected: {"unknown_index", "bad_mac1"},
    replayed_initiations: {"replayed_initiation", "rate_limited", "cookie_required"},
    altered_initiations: {"bad_handshake", "invalid_key_share", "rate_limited", "cookie_required", "malformed"},
    initiations_of_low_order: {"invalid_key_share", "rate_limited", "cookie_required"},
    responses: {"unexpected_response", "unknown_index", "rate_limited", "cookie_required"},
    cookies: {"unexpected_cookie", "unknown_index"},
}
"""Each attack, with the reasons that its datagrams are dropped for."""


class Attacked:
    """The daemon, its station, and the man in the middle."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        private = (setup.daemon.folder / "stations.key").read_text().strip()
        daemon_key = keys.decode_key(keys.public_key_text(private))
        self.middle = Middle(setup.tablet.daemon, daemon_key)
        setup.tablet.daemon = self.middle.address
        self._numbers = count(1)
        self.sent: list[bytes] = []

    def command(self) -> bytes:
        """Another command of the station's pilot."""
        frame = command_long(ARM, 255, param1=float(next(self._numbers)))
        self.setup.tablet.send(self.setup.tablet.client.udp(frame))
        self.sent.append(frame)
        return frame

    async def until_one_passes(self) -> None:
        """Commands, until one arrives."""
        before = len(self.sent)
        while not set(self.sent[before:]) & set(self.setup.autopilot.frames):
            self.command()
            await asyncio.sleep(0.05)

    async def until_dropped(self, attempts: int, before: int) -> dict[str, int]:
        """The daemon has counted them."""
        status = await self.setup.daemon.until(lambda status: sum(status["drops"].values()) >= before + attempts)
        return dict(status["drops"])

    def check(self) -> None:
        """Each command arrived at most once, as it was."""
        arrived = [frame for frame in self.setup.autopilot.frames if frame in set(self.sent)]
        assert len(arrived) == len(set(arrived))
        strange = [frame for frame in self.setup.autopilot.frames if frame not in set(self.sent)]
        assert not any(frame[7:10] == self.sent[0][7:10] for frame in strange)  # no other command


@pytest.fixture
async def attacked() -> AsyncIterator[Attacked]:
    async with Stage() as stage:
        attacked = Attacked(Setup(stage, await stage.client()))
        yield attacked
        attacked.setup.tablet.close()
        attacked.middle.close()


async def test_no_attack_delivers_a_command(attacked: Attacked) -> None:
    """Each in turn at one daemon: every datagram is dropped for a reason of the table, then commands pass."""
    middle = attacked.middle
    await attacked.setup.connect()
    await attacked.until_one_passes()
    for attack, reasons in ATTACKS.items():
        before = dict((await attacked.setup.daemon.status())["drops"])
        middle.kept = []
        if attack is altered_data:
            for _ in range(10):
                attacked.command()
            await waiting.until(lambda: len(middle.kept or []) >= 10)
        attempts = list(attack(middle))
        for datagram in attempts:
            middle.inject(datagram)
        after = await attacked.until_dropped(len(attempts), sum(before.values()))
        assert len(attempts) >= ATTEMPTS // 10, attack.__name__
        grown = {reason for reason, number in after.items() if number > before.get(reason, 0)}
        assert grown <= reasons, attack.__name__
        middle.pass_on()
        await attacked.until_one_passes()
        attacked.check()
