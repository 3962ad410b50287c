"""What befalls a fleet in a random history: radios, cuts, restarts, moves, replays, floods, relays and NATs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

from tests.network.attackers import Flooder, Recorder
from tests.network.drone import Drone
from tests.network.fleet import Fleet
from tests.network.path_misfortunes import Befalling, PathMisfortunes, random_address, random_radio
from tests.network.relay_fleet import RelayFleet
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.relay_records import RELAYED

_FORGED = 50


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

    def _data(self) -> list[tuple[bytes, tuple[str, int], tuple[str, int]]]:
        data = [recorded for recorded in self._recorder.recorded if recorded[0][0] == RELAYED]
        return self._lot.choices(data, k=_FORGED) if data else []


_KEPT = 2000
_SHARE_OF_PATHS = 0.85
"""Of the misfortunes in a fleet with several paths: most concern one path, so that another one works."""
_SHARE_OF_RELAYS = 0.4


class Misfortunes(Befalling):
    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self.events: Counter[str] = Counter()
        self._recorder = Recorder(fleet.network, keep=_KEPT)
        self._of_paths = PathMisfortunes(fleet)
        self._of_relays = RelayMisfortunes(fleet, self._recorder) if isinstance(fleet, RelayFleet) else None
        self._kinds: list[tuple[str, Callable[[], None]]] = [
            ("other radios", lambda: self._network.set_radio(random_radio(fleet))),
            ("cut", self._cut),
            ("cut one way", lambda: self._network.cut_one_way(*self._random_peers())),
            ("partition", self._partition),
            ("cuts healed", self._network.heal),
            ("restart", lambda: self._random_drone().start(fleet.random_clock())),
            ("off for a while", self._off),
            ("close", self._close),
            ("move", self._move),
            ("clock ahead", lambda: self._random_drone().leap(self._lot.choice((0.3, 3.0, 100.0, 5000.0)))),
            ("peer removed", self._remove),
            ("peer back", self._restore),
            ("features offered", self._offer),
            ("replays", self._replay),
            ("flood by strangers", partial(self._flood, knows_key=False)),
            ("flood with the public key", partial(self._flood, knows_key=True)),
        ]

    def befall(self, until: float) -> None:
        """Let something happen now. What ends by itself ends by ``until``, or not at all."""
        self._until = until
        if self._of_relays is not None and self._lot.random() < _SHARE_OF_RELAYS:
            name = self._of_relays.befall(until)
        elif self._fleet.plan.has_paths and self._lot.random() < _SHARE_OF_PATHS:
            name = self._of_paths.befall(until)
        else:
            name, befalls = self._lot.choice(self._kinds)
            self._network.note(name)
            befalls()
        self.events[name] += 1

    def _cut(self) -> None:
        a, b, _ = self._lot.choice(self._fleet.pairs)
        self._network.cut(a, b)

    def _partition(self) -> None:
        drones = self._fleet.drones
        here = set(self._lot.sample([drone.name for drone in drones], self._lot.randint(1, len(drones) - 1)))
        for a, b, _ in self._fleet.pairs:
            if (a.name in here) != (b.name in here):
                self._network.cut(a, b)

    def _off(self) -> None:
        drone = self._random_drone()
        drone.stop()
        self._start_later(drone)

    def _close(self) -> None:
        drone = self._random_drone()
        if drone.node is not None:
            self._network.perform(drone, drone.node.close(drone.local_now))
            drone.stop()
            self._start_later(drone)

    def _start_later(self, drone: Drone) -> None:
        clock = self._fleet.random_clock()
        self._later(self._lot.choice((0.5, 5.0, 400.0)), lambda: drone.start(clock) if drone.node is None else None)

    def _move(self) -> None:
        drone = self._lot.choice(self._fleet.wanderers)
        drone.move_socket(0, random_address(self._fleet, drone))

    def _remove(self) -> None:
        a, b = self._random_peers()
        if b.name in a.acquaintances:
            a.remove(b)

    def _restore(self) -> None:
        for a, b, _ in self._fleet.pairs:
            for drone, other in ((a, b), (b, a)):
                if other.name in drone.removed and self._lot.random() < 0.5:
                    drone.restore(other)

    def _offer(self) -> None:
        a, b = self._random_peers()
        if a.node is not None and b.name in a.acquaintances:
            kept = a.peer(b).settings.link.features & c.FEATURE_RECORDS  # relays need it
            a.node.offer(a.peer(b), kept | self._lot.randint(0, c.KNOWN_FEATURES), a.local_now)

    def _replay(self) -> None:
        if self._recorder.recorded:
            for datagram, source, destination in self._lot.choices(self._recorder.recorded, k=50):
                self._network.inject(datagram, self._lot.choice((source, destination)), destination)

    def _flood(self, *, knows_key: bool) -> None:
        lot = self._lot
        sources = lot.choice((1, 8, 64, 64, 1200))
        flooder = Flooder(self._network, self._random_drone(), lot, sources=sources, knows_key=knows_key)
        duration_s = lot.choice((1.0, 3.0, 8.0))
        flooder.flood(lot.choice((50.0, 200.0, 400.0)), min(self._network.now + duration_s, self._until))

    def _random_drone(self) -> Drone:
        return self._lot.choice(self._fleet.drones)

    def _random_peers(self) -> tuple[Drone, Drone]:
        a, b, _ = self._lot.choice(self._fleet.pairs)
        return (a, b) if self._lot.random() < 0.5 else (b, a)
