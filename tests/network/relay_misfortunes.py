"""What befalls relays, NATs and data along relays in a random history."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tests.network.attackers import Recorder
from tests.network.members import Member
from tests.network.path_misfortunes import Befalling, random_address
from tests.network.relay_fleet import RelayFleet
from uavlinkd.core import constants as c
from uavlinkd.core.relay_records import RELAYED, token_datagram

_FORGED = 50
_STRANGER = ("198.51.100.66", 4000)


class RelayMisfortunes(Befalling):
    def __init__(self, fleet: RelayFleet, recorder: Recorder) -> None:
        super().__init__(fleet)
        self._recorder = recorder
        self._kinds: tuple[tuple[str, Callable[[], None]], ...] = (
            ("relay restarts", lambda: self._lot.choice(fleet.relays).start(fleet.random_clock())),
            ("relay off for a while", self._off),
            ("relay unreachable for a member", self._cut),
            ("NAT forgets", self._forget),
            ("member roams", self._roam),
            ("data replayed", self._replay),
            ("data forged", self._forge),
            ("netcheck, and tokens forged", self._test_filters),
        )

    def befall(self, until: float) -> str:
        self._until = until
        name, befalls = self._lot.choice(self._kinds)
        self._network.note(name)
        befalls()
        return name

    def _off(self) -> None:
        relay = self._lot.choice(self._fleet.relays)
        relay.stop()
        clock = self._fleet.random_clock()
        self._later(self._lot.choice((0.3, 2.0, 15.0)), lambda: relay.start(clock) if relay.node is None else None)

    def _cut(self) -> None:
        drone, relay = self._lot.choice(self._fleet.drones), self._lot.choice(self._fleet.relays)
        for socket in range(len(drone.addresses)):
            hop = drone.hop(socket, relay, 0)
            self._network.cut_path(hop)
            self._later(self._lot.choice((1.0, 5.0, 15.0)), partial(self._network.heal_path, hop))

    def _forget(self) -> None:
        drone = self._lot.choice(self._fleet.drones)
        drone.forget_mappings(self._lot.choice(list(drone.nats)))

    def _roam(self) -> None:
        """Another network, and so another NAT."""
        drone = self._lot.choice(self._fleet.drones)
        drone.move_socket(self._lot.choice(list(drone.nats)), random_address(self._fleet, drone))

    def _replay(self) -> None:
        for datagram, source, destination in self._data():
            self._network.inject(datagram, self._lot.choice((source, destination)), destination)

    def _forge(self) -> None:
        """Another handle, another sender, altered or shortened data, a relay inside a relay."""
        lot = self._lot
        for datagram, sender, destination in self._data():
            header, inner, source = datagram[:3], bytearray(datagram[3:]), sender
            match lot.randrange(5):
                case 0:
                    header = bytes((RELAYED,)) + lot.randbytes(2)
                case 1:
                    source = lot.choice([address for address in self._network.owners if address != destination])
                case 2:
                    inner[lot.randrange(len(inner))] ^= 1 << lot.randrange(8)
                case 3:
                    del inner[lot.randrange(len(inner)) :]
                case _:
                    inner[:0] = header
            self._network.inject(header + inner, source, destination)

    def _test_filters(self) -> None:
        """An attacker sends other tokens from a relay's host, and the true ones from other hosts and ports."""
        lot, drone, relay = self._lot, self._lot.choice(self._fleet.drones), self._lot.choice(self._fleet.relays)
        if not isinstance(drone, Member) or drone.relays is None:
            return
        drone.test_filters()
        host, port = relay.addresses[0]
        for _ in range(_FORGED):
            token, source = lot.randbytes(c.FILTER_TOKEN_BYTES), (host, lot.randrange(2**16))
            if drone.relays.filter_tests._tests and lot.random() < 0.5:
                token, source = (
                    lot.choice(list(drone.relays.filter_tests._tests)),
                    lot.choice(((host, port), _STRANGER)),
                )
            socket = lot.randrange(len(drone.addresses))
            self._network.inject(token_datagram(token), source, drone.source_for(socket, relay.addresses[0]))

    def _data(self) -> list[tuple[bytes, tuple[str, int], tuple[str, int]]]:
        data = [recorded for recorded in self._recorder.recorded if recorded[0][0] == RELAYED]
        return self._lot.choices(data, k=_FORGED) if data else []
