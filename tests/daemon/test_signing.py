"""Two real daemons, a ground station, and an autopilot that signs, on each kind of endpoint."""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.daemon_pair import ANY_PORT, are_linked, config
from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.wire import KEY, OTHER, keyed
from tests.samples import pack, read
from tests.waiting import until
from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import LINK_ID, SigningConfig
from uavlinkd.daemon import signing
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.signing.endpoint_signing import MOST_OF_SOURCE
from uavlinkd.observe import facts
from uavlinkd.protocol.crypto import Secret

HEARTBEAT_S = 0.1
"""Between two of the autopilot: a real one sends one a second."""


@pytest.fixture(autouse=True)
def _listens_for_less_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The autopilot here sends ten times as many HEARTBEATs."""
    monkeypatch.setattr(signing, "LISTENS_S", 0.5)
    monkeypatch.setattr(signing, "CONFIRMED_S", 1.5)


class Cable:
    """The autopilot's end of its endpoint."""

    def __init__(self, autopilot: Autopilot, fd: int, send: Callable[[bytes], object]) -> None:
        self.autopilot, self._fd, self._send = autopilot, fd, send
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(fd, self._read)
        self._beating = asyncio.create_task(self._beat())

    def _read(self) -> None:
        with suppress(BlockingIOError):
            for answer in self.autopilot.receive(os.read(self._fd, 4096)):
                self.send(answer)

    def send(self, raw: bytes) -> None:
        with suppress(OSError):
            self._send(raw)

    async def _beat(self) -> None:
        while True:
            self.send(self.autopilot.heartbeat())
            await asyncio.sleep(HEARTBEAT_S)

    def close(self) -> None:
        self._loop.remove_reader(self._fd)
        self._beating.cancel()


class Pair:
    """A vehicle's daemon with an autopilot, and a ground station's."""

    def __init__(self, vehicle: Daemon, ground: Daemon, cable: Cable, station: socket.socket) -> None:
        self.vehicle, self.ground, self.cable, self.station = vehicle, ground, cable, station
        self.autopilot = cable.autopilot
        (self.endpoint,) = vehicle.parts.local.endpoints
        self._number = 0

    def heard(self) -> list[bytes]:
        """The datagrams that reached the ground station since the last call."""
        return _all(self.station)

    def command(self) -> int:
        """Send a numbered command."""
        self._number += 1
        message = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, self._number, 0, 0, 0, 0, 0)
        (endpoint,) = self.ground.parts.local.endpoints
        self.station.sendto(pack(message, 255, 190), endpoint._sock.getsockname())  # type: ignore[attr-defined]
        return self._number

    async def commands_pass(self) -> None:
        """Wait until a command of the station is executed, and none is under way."""
        while not await self._is_executed(self.command()):
            pass

    async def _is_executed(self, number: int) -> bool:
        with suppress(TimeoutError):
            await until(lambda: any(one.param2 == number for one in self.autopilot.accepted), 0.5)
            return True
        return False

    async def ask(self, action: str, key: Secret | None = KEY, endpoint: str = "client") -> dict[str, Any]:
        text = "" if key is None else encode_key(key.reveal())
        request = {"action": action, "endpoint": endpoint, "key": text, "link_id": LINK_ID}
        answer = await self.vehicle.answer(f"signing {json.dumps(request)}")
        assert answer is not None
        return answer


@asynccontextmanager
async def flying(
    kind: str, autopilot: Autopilot, key: Secret | None = None, *, state: Path | None = None
) -> AsyncIterator[Pair]:
    """Linked daemons; the vehicle's has a serial, UDP or TCP endpoint."""
    closing: list[Callable[[], object]] = []
    listener = socket.socket()
    closing.append(listener.close)
    if kind == "serial":
        master, slave = os.openpty()
        closing += [lambda: os.close(master), lambda: os.close(slave)]
        url: Any = SerialUrl(os.ttyname(slave), 115200)
    elif kind == "tcp":
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        url = NetworkUrl(EndpointKind.TCP, replace(ANY_PORT, port=listener.getsockname()[1]))
    else:
        url = NetworkUrl(EndpointKind.UDPIN, ANY_PORT)
    of_vehicle = config("left", url)
    endpoint = replace(of_vehicle.endpoints[0], signing=None if key is None else SigningConfig(key))
    vehicle = Daemon(replace(of_vehicle, signing_state=state, endpoints=(endpoint,)))
    await vehicle.start()
    address = tuple(vehicle.parts.peer_sockets.addresses)
    ground = Daemon(config("right", NetworkUrl(EndpointKind.UDPIN, ANY_PORT), address))
    await ground.start()
    try:
        if kind == "serial":
            os.set_blocking(master, False)
            cable = Cable(autopilot, master, lambda raw: os.write(master, raw))
        else:
            sock = socket.socket(type=socket.SOCK_DGRAM)
            if kind == "tcp":
                sock.close()
                sock = await asyncio.to_thread(lambda: listener.accept()[0])
            else:
                sock.connect(vehicle.parts.local.endpoints[0]._sock.getsockname())  # type: ignore[attr-defined]
            sock.setblocking(False)
            cable = Cable(autopilot, sock.fileno(), sock.send)
            closing.append(sock.close)
        closing.insert(0, cable.close)
        station = socket.socket(type=socket.SOCK_DGRAM)
        station.bind(("127.0.0.1", 0))
        station.setblocking(False)
        closing.append(station.close)
        await until(lambda: are_linked(vehicle, ground))
        yield Pair(vehicle, ground, cable, station)
    finally:
        for close in closing:
            close()
        await vehicle.stop()
        await ground.stop()


@pytest.mark.parametrize("kind", ["serial", "tcp", "udpin"])
async def test_a_life(kind: str) -> None:
    """A key is set up, rotated and cleared under traffic; what is unsigned is dropped in between."""
    autopilot = Autopilot()
    async with flying(kind, autopilot) as pair:
        assert await pair.ask("setup") == {
            "problem": "",
            "is_changed": True,
            "system": 1,
            "accepts_unsigned": False,
        }
        assert autopilot.key == KEY.reveal()
        await pair.commands_pass()
        await until(lambda: any(not raw[2] for raw in pair.heard()))  # telemetry, as if it had not been signed
        pair.cable.send(pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)))
        await until(lambda: pair.endpoint.failures["unsigned"] == 1)
        autopilot.restart()
        await pair.commands_pass()
        first = autopilot.key
        assert (await pair.ask("rotate", OTHER))["is_changed"]
        assert first != autopilot.key == OTHER.reveal()
        await pair.commands_pass()
        assert (await pair.ask("clear", None))["is_changed"]
        assert not autopilot.has_key
        await pair.commands_pass()
        assert pair.endpoint.signing is None
        assert autopilot.rejected["unsigned"] == 4  # two questions behind each new key


async def test_an_autopilot_that_takes_what_is_unsigned() -> None:
    """ArduPilot does so on its USB port: the answer says it."""
    async with flying("udpin", Autopilot(is_usb=True)) as pair:
        answer = await pair.ask("setup")
        assert answer["is_changed"]
        assert answer["accepts_unsigned"]


async def test_what_keeps_an_autopilot_from_a_key() -> None:
    """Each problem has its sentence, and changes nothing."""
    autopilot = Autopilot()
    async with flying("udpin", autopilot) as pair:

        async def refused(text: str, action: str = "setup", *wish: Any) -> None:
            answer = await pair.ask(action, *wish)
            assert answer["is_changed"] is False
            assert text in answer["problem"]
            assert pair.endpoint.signing is None
            assert autopilot.key is None

        await refused("has no endpoint elsewhere", "setup", KEY, "elsewhere")
        await refused("begins it", "rotate")
        autopilot.is_armed = True
        await refused("is armed")
        autopilot.is_armed = False
        second = Autopilot(system=2)
        beating = asyncio.create_task(_beat(pair.cable.send, second))
        await refused("systems 1 and 2")
        beating.cancel()
        pair.cable.close()
        (port,) = pair.endpoint.ports
        await until(lambda: monotonic() - (port.received_at or 0.0) > HEARTBEAT_S)  # the last ones are read
        await refused("no autopilot was heard")


async def _beat(send: Callable[[bytes], object], autopilot: Autopilot) -> None:
    while True:
        send(autopilot.heartbeat())
        await asyncio.sleep(HEARTBEAT_S)


async def test_an_autopilot_with_another_key() -> None:
    """It keeps its key, and goes on as before."""
    autopilot = keyed(Autopilot(), OTHER)
    async with flying("udpin", autopilot) as pair:
        answer = await pair.ask("setup")
        assert answer["is_changed"] is False
        assert "a key that this daemon does not have" in answer["problem"]
        assert autopilot.key == OTHER.reveal()
        pair.command()  # as the first frame of a client does
        await until(lambda: bool(pair.heard()))


async def test_a_setup_that_is_not_confirmed() -> None:
    """The autopilot may have the key: the daemon signs when it shows that, and the same command ends well."""
    autopilot = Autopilot()
    async with flying("udpin", autopilot) as pair:
        autopilot.is_deaf = True
        answer = await pair.ask("setup")
        assert answer["is_changed"] is None
        assert "run the same command again" in answer["problem"]
        autopilot.is_deaf = False
        assert (await pair.ask("setup"))["is_changed"]
        assert (await pair.ask("setup"))["is_changed"]  # a command that was killed behind it
        await pair.commands_pass()


class Halved(Autopilot):
    """Its first key is the last that it receives: the direction to it is cut then, until ``is_mended``."""

    is_mended = False

    def receive(self, data: bytes) -> list[bytes]:
        self.is_deaf = self.has_key and not self.is_mended
        return super().receive(data)


async def test_clear_after_a_setup_that_was_not_confirmed() -> None:
    """The autopilot has the key, and has not proven it: the file with the only copy must not be deleted."""
    autopilot = Halved()
    async with flying("udpin", autopilot) as pair:
        assert (await pair.ask("setup"))["is_changed"] is None
        answer = await pair.ask("clear", None)
        assert answer["is_changed"] is False
        assert "run that one again" in answer["problem"]
        autopilot.is_mended = True
        assert (await pair.ask("setup"))["is_changed"]
        assert (await pair.ask("clear", None))["is_changed"]
        assert not autopilot.has_key


class Withheld(Autopilot):
    """It never gets the message that removes its key."""

    def receive(self, data: bytes) -> list[bytes]:
        if self.has_key and int.from_bytes(data[7:10], "little") == mavlink.MAVLINK_MSG_ID_SETUP_SIGNING:
            return []
        return super().receive(data)


async def test_a_stranger_does_not_confirm_that_a_key_was_removed() -> None:
    """The command deletes the only copy of the key then."""
    autopilot = Withheld()
    async with flying("udpin", autopilot) as pair:
        assert (await pair.ask("setup"))["is_changed"]
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.connect(pair.endpoint._sock.getsockname())  # type: ignore[attr-defined]
            beating = asyncio.create_task(_beat(stranger.send, Autopilot()))
            assert (await pair.ask("clear", None))["is_changed"] is None
            beating.cancel()
        assert pair.endpoint.failures["unsigned"]


async def test_a_key_reaches_one_client_only() -> None:
    """Another client that was there before would get the key in clear."""
    autopilot = Autopilot()
    async with flying("udpin", autopilot) as pair:
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.sendto(pack(mavlink.MAVLink_system_time_message(1, 1)), pair.endpoint._sock.getsockname())  # type: ignore[attr-defined]
            await until(lambda: len(pair.endpoint.ports) == 2)
            answer = await pair.ask("setup")
        assert answer["is_changed"] is False
        assert "several clients" in answer["problem"]
        assert not autopilot.has_key


async def test_a_client_that_comes_during_a_change_gets_no_key() -> None:
    """A program on this machine sees the command, and becomes a client while the autopilot's proof is awaited."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        await pair.commands_pass()
        autopilot.is_deaf = True
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            changing = asyncio.create_task(pair.ask("rotate", OTHER))
            assert pair.endpoint.signing is not None
            await until(lambda: len(pair.endpoint.signing.signers) == 2)  # type: ignore[union-attr]
            other.sendto(pack(mavlink.MAVLink_system_time_message(1, 1)), pair.endpoint._sock.getsockname())  # type: ignore[attr-defined]
            await until(lambda: len(pair.endpoint.ports) == 2)
            autopilot.is_deaf = False
            assert (await changing)["is_changed"] is None
            await pair.commands_pass()
            assert autopilot.key == KEY.reveal()
            assert OTHER.reveal() not in b"".join(_all(other))


async def test_a_stranger_gets_nothing_signed_but_questions() -> None:
    """A signature of its own for each client: with copies it would repeat a HEARTBEAT when the station is lost."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        await pair.commands_pass()
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.setblocking(False)
            stranger.sendto(pack(mavlink.MAVLink_system_time_message(1, 1)), pair.endpoint._sock.getsockname())  # type: ignore[attr-defined]
            await until(lambda: len(pair.endpoint.ports) == 2)
            (endpoint,) = pair.ground.parts.local.endpoints
            heartbeat = pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 255, 190)
            pair.station.sendto(heartbeat, endpoint._sock.getsockname())  # type: ignore[attr-defined]
            await until(lambda: any(one.get_type() == "HEARTBEAT" for one in autopilot.accepted))
            autopilot.accepted.clear()
            autopilot.restart()
            await pair.commands_pass()
            assert {data[7] for data in _all(stranger)} <= {mavlink.MAVLINK_MSG_ID_TIMESYNC}


def _all(sock: socket.socket) -> list[bytes]:
    """The datagrams that wait at a socket."""
    datagrams = []
    with suppress(BlockingIOError):
        while True:
            datagrams.append(sock.recv(4096))
    return datagrams


async def test_another_key_is_only_for_the_autopilot_that_proves_this_one() -> None:
    """Somebody that sends HEARTBEATs without signatures must not get the place of an autopilot that is off."""
    autopilot = Autopilot()
    async with flying("udpin", autopilot, KEY) as pair:
        for byte in (b"3", b"4", b"5"):
            answer = await pair.ask("rotate", Secret(byte * 32))
            assert answer["is_changed"] is False
            assert "has not proven" in answer["problem"]
        assert not autopilot.has_key
        assert pair.endpoint.signing is not None
        assert [one.secret for one in pair.endpoint.signing.signers] == [KEY, Secret(b"5" * 32)]


async def test_one_change_at_a_time_and_for_an_autopilot_that_answers() -> None:
    """A change is refused while another goes on, and ``clear`` where the direction to the autopilot is cut."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        await pair.commands_pass()
        autopilot.is_deaf = True
        answers = await asyncio.gather(pair.ask("clear", None), pair.ask("clear", None))
        assert [answer["is_changed"] for answer in answers] == [False, False]
        assert "has not proven" in answers[0]["problem"]
        assert "another change" in answers[1]["problem"]


async def test_all_clients_of_a_station_are_one_source() -> None:
    """A captured station opens new clients: each would have places at the autopilot of its own."""
    autopilot = keyed(Autopilot())
    async with flying("serial", autopilot, KEY) as pair:
        await pair.commands_pass()
        gate = pair.vehicle.parts.local.policies["client"].incoming
        (port,) = pair.endpoint.ports
        signed = 0
        for component in range(1, 50):
            raw = pack(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 1, 0, 0, 0, 0, 0), 200, component)
            signed += len(port.signed([read(raw)], Source("captured", gate)))
        assert signed == MOST_OF_SOURCE


async def test_a_daemon_with_a_key() -> None:
    """A daemon that starts with a key hears only who has it, also at a port to which anybody can send."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        await pair.commands_pass()
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.sendto(pack(mavlink.MAVLink_system_time_message(1, 1)), pair.endpoint._sock.getsockname())  # type: ignore[attr-defined]
            await until(lambda: pair.endpoint.failures["unsigned"] == 1)
            await pair.commands_pass()


async def test_commands_pass_behind_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """They need not wait for the autopilot's next HEARTBEAT: here there is one, and then the answer."""
    monkeypatch.setattr("tests.daemon.test_signing.HEARTBEAT_S", 3600.0)
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        async with asyncio.timeout(10.0):
            await pair.commands_pass()
        assert pair.endpoint.counters.frames == 2


async def test_an_autopilot_that_lost_its_key() -> None:
    """It was erased, or replaced: setup hands the same key over again, and clear ends what it began."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY) as pair:
        await pair.commands_pass()
        autopilot.erase()
        assert (await pair.ask("setup"))["is_changed"]
        assert autopilot.key == KEY.reveal()
        await pair.commands_pass()
        autopilot.erase()
        assert (await pair.ask("clear", None))["is_changed"]
        await pair.commands_pass()
        assert pair.endpoint.signing is None


async def test_status_of_an_autopilot_that_lost_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """It proved the key, and does not prove it now."""
    autopilot = Autopilot()

    async def proves() -> bool:
        answer: Any = await pair.vehicle.answer("status")
        return bool(answer["endpoints"]["client"]["signing"]["is_verified"])

    async with flying("udpin", autopilot) as pair:
        assert (await pair.ask("setup"))["is_changed"]
        assert await proves()
        monkeypatch.setattr(facts, "SILENT_S", 2 * HEARTBEAT_S)
        autopilot.erase()
        await until(lambda: pair.endpoint.failures["unsigned"] > 4)
        assert not await proves()


async def test_a_reload_knows_the_key() -> None:
    """The running configuration has what the command writes into the file."""
    async with flying("udpin", Autopilot()) as pair:
        for action, key in (("setup", KEY), ("rotate", OTHER), ("clear", None)):
            assert (await pair.ask(action, key))["is_changed"]
            (endpoint,) = pair.vehicle.parts.config.endpoints
            assert endpoint.signing == (None if key is None else SigningConfig(key))


async def test_timestamps_that_the_autopilot_remembers() -> None:
    """A new key after a cleared one: the daemon forgot its timestamps, and the autopilot did not."""
    autopilot = Autopilot()
    async with flying("udpin", autopilot) as pair:
        assert (await pair.ask("setup"))["is_changed"]
        autopilot.set_time(2**45)  # satellites: the year 2026
        await pair.commands_pass()
        assert (await pair.ask("clear", None))["is_changed"]
        assert (await pair.ask("setup", OTHER))["is_changed"]
        await pair.commands_pass()


async def test_both_ends_without_power(tmp_path: Path) -> None:
    """What was recorded in an earlier flight is old, also if the autopilot begins again with its key's timestamp."""
    autopilot, state = keyed(Autopilot("px4")), tmp_path / "left.signing-state"
    async with flying("udpin", autopilot, KEY, state=state) as pair:
        autopilot.set_time(2**45)
        await until(lambda: state.exists() and int(state.read_text()) > 2**45)
        recorded = autopilot.heartbeat()
    autopilot.restart()
    async with flying("udpin", autopilot, KEY, state=state) as pair:
        await pair.commands_pass()
        before = pair.endpoint.failures["replayed"]
        pair.cable.send(recorded)
        await until(lambda: pair.endpoint.failures["replayed"] > before)


async def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """Frames pass without the file."""
    autopilot = keyed(Autopilot())
    async with flying("udpin", autopilot, KEY, state=tmp_path / "no" / "state") as pair:
        await pair.commands_pass()
        await until(lambda: pair.vehicle.parts.signing.has_failed)
        await pair.commands_pass()
