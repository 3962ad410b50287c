"""Further stages of real daemons: with two paths, on a serial line, and behind a hostile relay."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import RelayServer
from uavlinkd.lab.evaluation.middle import HOST, Interventions, interventions, silent_log
from uavlinkd.lab.evaluation.stage import DaemonStage, until
from uavlinkd.lab.hostile.hostile_relay import HostileRelay, HostileRelaySettings
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.mitm.line_attacks import parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.system.addresses import Address

SLOWER: Final = ("both/2", RadioSettings(delay_s=0.02))
"""The second path: the election prefers the first one."""
SIK: Final = ModemSettings()
_ENDS: Final = dict(zip(ModemEnd, ("drone0", "drone1"), strict=True))
AMPLE: Final = 10**10
RELAY_LINK: Final = Link((SUITES_BY_NAME["x25519"],), features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS)
RELAY_PEERS: Final = 16


class TwoPathStage(DaemonStage):
    """Two configured paths between each pair."""

    async def settle(self) -> None:
        """Wait until the first path is the best one of every drone.

        Raises:
            EvaluationError: it does not become the best path.
        """
        first = {
            (way.sender, way.receiver): f"{HOST}:{port}" for way, port in self.middle.ports.items() if way.path == 1
        }

        async def is_best() -> bool:
            statuses = {name: (await drone.ask()).get("peers", {}) for name, drone in self.drones.items()}
            return first == {(one, to): peer["path"] for one, peers in statuses.items() for to, peer in peers.items()}

        await until(is_best, "the faster path did not become the best one")


class MiddleLine:
    """Two emulated modems in this process, with the attacks on their lines.

    The attacker is the modem's firmware, or a device on the wires. It puts bytes on the lines to both hosts, or holds
    back what they should receive. It has no keys, but it knows the framing: it makes frames with a valid CRC.
    """

    def __init__(self, names: Sequence[str], folder: Path, seed: int) -> None:
        del names
        self.ports: Mapping[Direction, int] = {}
        self.devices = {name: folder / end for end, name in _ENDS.items()}
        left, right = self.devices.values()
        self._modems = ModemPorts(PortSettings(left, right, SIK, seed=seed))
        self._modems.log = silent_log()

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Plug both modems in. They need to know nothing about the daemons."""
        del addresses, public_keys
        await self._modems.start()

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks. What the modems hold back is released."""
        assert not objects, "the attacker on the line has no keys"
        self._modems.change_attacks([parse_line_attack(text) for text in specs])
        for end in ModemEnd:
            self._modems.link.release(end, monotonic())

    async def statistics(self) -> Interventions:
        counts = self._modems.interventions
        return Interventions({f"{attack}: {operation}": count for (attack, operation), count in counts.items()})

    async def stop(self) -> None:
        await self._modems.stop()


class LineStage(DaemonStage):
    """Two daemons whose only path is a serial line with two modems."""

    middle: MiddleLine

    def addresses(self, one: str, other: str) -> list[object]:
        del one, other
        return [{"network": "sik"}]

    def networks(self, name: str) -> list[dict[str, object]]:
        return [{"name": "sik", "serial": f"{self.middle.devices[name]}:{SIK.line_baud:.0f}"}]


class MiddleRelay:
    """A hostile relay in this process. ``names``: of its members."""

    def __init__(self, names: Sequence[str], folder: Path, seed: int) -> None:
        del folder
        self.ports: Mapping[Direction, int] = {}
        """Of a proxy; members reach a relay by its own port."""
        (self.port,) = free_ports(1)
        self._names = tuple(names)
        self._seed = seed
        self._private = os.urandom(c.KEY_BYTES)
        self.public_key = KeyPair(self._private).public

    @property
    def section(self) -> dict[str, object]:
        return {"name": "vps", "public_key": encode_key(self.public_key), "addresses": [f"{HOST}:{self.port}"]}

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start for members with these keys. They reach the relay; it does not need their ports."""
        del addresses
        members = (PeerSettings(name, public_keys[name], None, RELAY_LINK) for name in self._names)
        settings = HostileRelaySettings(
            name="vps",
            private_key=Secret(self._private),
            listen=(Address(HOST, self.port),),
            server=RelayServer(tuple(MemberSettings(member, RELAY_PEERS, AMPLE) for member in members), AMPLE),
            seed=self._seed,
        )
        self.relay = HostileRelay(settings)
        self.relay.log = silent_log()
        await self.relay.start()

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        assert not objects, "this attacker has no key of a member"
        self.relay.attack(specs)

    async def statistics(self) -> Interventions:
        return interventions(self.relay.statistics())

    async def stop(self) -> None:
        await self.relay.stop()


class RelayStage(DaemonStage):
    """Daemons that know only a hostile relay."""

    middle: MiddleRelay

    def addresses(self, one: str, other: str) -> list[object]:
        del one, other
        return []

    def relays(self, name: str) -> list[dict[str, object]]:
        del name
        return [self.middle.section]
