"""Each walk-through of ``configs/README.md``, as written: its commands, its files, then a frame in each direction."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.compose.machine import Machine
from tests.namespaces import need_namespaces
from tests.processes.frames import GROUND_SYSTEM, command_long, ground_heartbeat, heartbeat, numbered
from tests.samples import pack
from tests.walkthroughs.hosts import Autopilot, Container, GroundStation, Host, Network, until

PAGE = Path(__file__).parents[2] / "configs/README.md"
_BLOCK = re.compile(r"^```(sh|toml)\n# (?:(\S+) )?on (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_OTHER_BLOCK = re.compile(r"^```(?:sh|toml)\n(?!# (?:\S+ )?on \S+\n)", re.MULTILINE)
PLACEHOLDER = re.compile(r"PUBLIC-KEY-OF-([\w-]+)")


class Block(NamedTuple):
    """Commands for a machine, or the text of a file."""

    host: str
    file: str
    """The file's name; empty for commands."""
    text: str

    @property
    def commands(self) -> list[str]:
        return self.text.splitlines()


def sections() -> dict[str, list[Block]]:
    """The blocks of each numbered section, in the order in which a reader follows them."""
    parts = re.split(r"^## (\d+ .*)$", PAGE.read_text(), flags=re.MULTILINE)
    return {title: list(_blocks(text)) for title, text in zip(parts[1::2], parts[2::2], strict=True)}


def _blocks(text: str) -> Iterator[Block]:
    assert not _OTHER_BLOCK.search(text), "a block does not name its machine"
    for kind, file, host, body in _BLOCK.findall(text):
        assert (kind == "toml") == bool(file), f"a block on {host}: {body[:40]}"
        yield Block(host, file, body)


SECTIONS = sections()
CARRIER_NAT = """
table ip carrier {
    chain out {
        type nat hook postrouting priority 100
        ip saddr 100.64.0.0/24 masquerade random
    }
    chain in {
        type filter hook forward priority 0
        ip daddr 100.64.0.0/24 ct state new drop
    }
}
"""


class Walk:
    """The hosts of a walk-through, and what a reader has seen so far."""

    def __init__(self, folder: Path) -> None:
        self.network = Network(folder)
        self.hosts: dict[str, Host | Container] = {}
        self._stack = ExitStack()
        self._stack.callback(self.network.switch.close)
        self._public_keys: dict[str, str] = {}

    def add_host(self, name: str, *addresses: str) -> Host:
        host = Host(self.network, name)
        self.hosts[name] = host
        self._stack.callback(host.close)
        self.network.connect(host, *addresses)
        return host

    def add_container(self, name: str, machine: Machine, *addresses: str) -> Container:
        container = self.hosts[name] = Container(name, machine, self.network.folder)
        self.network.connect(container, *addresses)
        return container

    def add_ground_station(self, host: Host) -> GroundStation:
        station = GroundStation(host)
        self._stack.callback(station.close)
        return station

    def close(self) -> None:
        self._stack.close()

    def follow(self, blocks: Sequence[Block]) -> None:
        for block in blocks:
            host = self.hosts[block.host]
            if block.file:
                text = PLACEHOLDER.sub(lambda match: self._public_keys[match[1]], block.text)
                host.save(block.file, text)
            for command in block.commands if not block.file else ():
                self._type(host, command)

    def _type(self, host: Host | Container, command: str) -> None:
        if " fleet " in command:  # there is no terminal
            host.run("umask 077 && echo any passphrase >passphrase")
            command = re.sub(r"( fleet \w+)", r"\1 --passphrase-file passphrase", command)
        if isinstance(host, Host) and command.startswith("uavlinkd run "):
            host.start(command)
        elif "uavlinkd status" in command or "uavlinkd reload" in command:  # the daemon may be starting
            until(lambda: host.try_to(command).returncode == 0, lambda: self.state_of(host, command))
        else:
            output = host.run(command)
            if "keygen" in command:
                self._public_keys[host.name] = output.split()[-1]

    def state_of(self, host: Host | Container, command: str) -> str:
        """The last output, and all logs, for when a step fails."""
        logs = "\n".join(f"--- {name}\n{other.log}" for name, other in self.hosts.items())
        done = host.try_to(command)
        return f"{host.name}: {command}\n{done.stdout}{done.stderr}\n{logs}"


@pytest.fixture
def walk(tmp_path: Path) -> Iterator[Walk]:
    """No hosts yet."""
    need_namespaces("nft")
    with closing(Walk(tmp_path)) as made:
        yield made


def blocks_of(number: int) -> list[Block]:
    return next(blocks for title, blocks in SECTIONS.items() if title.startswith(f"{number} "))


def position(system: int) -> bytes:
    return numbered(1, system)


def mission_count(system: int, target: int) -> bytes:
    """A vehicle's answer to its operator. To another autopilot it is a write."""
    return pack(mavlink.MAVLink_mission_count_message(target, 1, 3), system)


def return_home(target: int) -> bytes:
    """A command of the ground station."""
    return command_long(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, GROUND_SYSTEM, (target, 1))


def converse(walk: Walk, autopilots: dict[int, Autopilot], station: GroundStation) -> None:
    """Each autopilot's position reaches the ground station, whose command reaches that autopilot."""

    def is_done() -> bool:
        for system, autopilot in autopilots.items():
            autopilot.send(heartbeat(system) + position(system))
            station.send(return_home(system))
        station.send(ground_heartbeat())
        return all(
            position(system) in station.poll() and return_home(system) in autopilot.poll()
            for system, autopilot in autopilots.items()
        )

    until(is_done, lambda: "\n".join(host.log for host in walk.hosts.values()))


def test_every_section_is_run() -> None:
    """A new walk-through needs a test, here or, for the Raspberry Pi's, in ``tests/packages``."""
    assert [title.split()[0] for title in SECTIONS] == ["1", "2", "3", "4", "5", "6"]
    assert all(SECTIONS.values())


def test_ground_station_and_one_vehicle(walk: Walk) -> None:
    """The autopilot is a serial device of the vehicle."""
    vehicle = walk.add_host("vehicle", "192.168.1.10/24")
    station = walk.add_ground_station(walk.add_host("laptop", "192.168.1.20/24"))

    walk.follow(blocks_of(1))
    converse(walk, {1: Autopilot(vehicle)}, station)


def test_two_vehicles(walk: Walk) -> None:
    """Each autopilot gets the other's position, and no command."""
    one = Autopilot(walk.add_host("drone1", "10.13.0.1/24"))
    two = Autopilot(walk.add_host("drone2", "10.13.0.2/24"))
    walk.follow(blocks_of(2))

    def is_done() -> bool:
        one.send(return_home(2) + position(1))
        two.send(return_home(1) + position(2))
        return position(2) in one.poll() and position(1) in two.poll()

    until(is_done, lambda: "\n".join(host.log for host in walk.hosts.values()))
    assert return_home(1) not in one.received
    assert return_home(2) not in two.received


def test_fleet(walk: Walk) -> None:
    """Both drones are linked; after the removal only the other one is."""
    autopilots = {number: Autopilot(walk.add_host(f"drone{number}", f"10.13.0.{number}/24")) for number in (1, 2)}
    laptop = walk.add_host("laptop", "10.13.0.254/24")
    station = walk.add_ground_station(laptop)
    blocks = blocks_of(3)
    before = next(number for number, block in enumerate(blocks) if "fleet remove" in block.text)

    walk.follow(blocks[:before])
    converse(walk, autopilots, station)
    walk.follow(blocks[before:])

    converse(walk, {1: autopilots[1]}, station)
    status = laptop.run("uavlinkd status --json --config gs.toml")
    assert list(json.loads(status)["peers"]) == ["drone1"]


def test_vehicle_behind_nat(walk: Walk) -> None:
    """The vehicle's packets come from its mobile network's address, and nothing gets in unasked."""
    vehicle = walk.add_host("vehicle", "100.64.0.5/24")
    station_host = walk.add_host("station", "203.0.113.10/24")
    carrier = walk.add_host("carrier", "100.64.0.1/24", "203.0.113.1/24")
    carrier.run("echo 1 > /proc/sys/net/ipv4/ip_forward")
    carrier.run(f"nft '{CARRIER_NAT}'")
    vehicle.run("ip route add default via 100.64.0.1")
    station = walk.add_ground_station(station_host)

    walk.follow(blocks_of(4))
    converse(walk, {1: Autopilot(vehicle)}, station)
    assert "203.0.113.1:" in station_host.run("uavlinkd status --config station.toml")


def test_hub(walk: Walk) -> None:
    """The ground station and the vehicles are linked with the hub only. A vehicle cannot write to the other one."""
    walk.add_host("hub", "10.13.0.100/24")
    laptop = walk.add_host("laptop", "10.13.0.50/24")
    autopilots = {number: Autopilot(walk.add_host(f"drone{number}", f"10.13.0.{number}/24")) for number in (1, 2)}
    station = walk.add_ground_station(laptop)

    walk.follow(blocks_of(5))
    autopilots[1].send(mission_count(1, target=2))
    converse(walk, autopilots, station)
    assert mission_count(1, target=2) not in autopilots[2].poll()
