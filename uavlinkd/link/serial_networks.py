"""The serial networks: their devices, as senders and receivers of datagrams beside the UDP sockets.

Each has one socket number, and one path: to the peer at the other end of the line. The file says what its radio
carries. It may carry less: at a distance, with interference, or because the file is wrong. Then the modem's queue
grows, and with it the time until an answer. :class:`LineRate` reduces the rate then.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import NetworkConfig
from uavlinkd.core.constants import LINE_BYTES
from uavlinkd.core.node import Node
from uavlinkd.core.path import SERIAL_HOST, Path, SocketAddress
from uavlinkd.core.path_measures import limit_at
from uavlinkd.core.path_state import PathState
from uavlinkd.core.peer import Peer
from uavlinkd.endpoints.sockets import Presence
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.networks import NetworkBudget, NetworkLog, Receive, network_status
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import meaning_of
from uavlinkd.system.stall import StallWatch

RECENT_S: Final = 10
"""What a line received is judged over this time. A modem that sends RADIO_STATUS does it more often."""
NOISE_PIECES: Final = 10
"""Damaged pieces in :data:`RECENT_S` that are reported, if they are more than :data:`NOISE_SHARE` of all."""
NOISE_SHARE: Final = 0.1
LATER_S: Final = 0.5
"""A round trip that is longer than the shortest one by more than this shows a queue in a modem."""
SHORTEST_OF_S: Final = 60.0
"""The shortest round trip of this time counts."""
GROWTH: Final = 1.05
"""Factor per second by which a reduced rate grows."""
GROWN_AFTER_S: Final = 60.0
"""It grows from the lowest to the full rate in less. A longer gap, such as a suspend, would overflow the power."""
LEAST_SHARE: Final = 1 / 16
"""The rate falls to this part of the full one at most,"""
LEAST_BITS_S: Final = 1000
"""and not below this: heartbeats and commands still pass."""
UNANSWERED: Final = 6
"""So many echo requests in a row, each after twice the time, show a queue that is longer than answers may take. Few
noisy radios lose so many."""
ENVELOPES: Final = 2
"""So many of the largest envelopes, one at each end, may precede a question or its answer without any queue in a
modem."""


class LineRate:
    """The rate at which this end sends: less if its modem turns out to queue. Sans-IO: ``now`` is monotonic seconds.

    ``full_bits_s``: that of the configuration. ``envelope_bytes``: the largest envelope with its framing.
    """

    __slots__ = ("_at", "_bits_s", "_envelope_bits", "_halved_at", "_is_late", "_shortest", "full_bits_s")

    def __init__(self, full_bits_s: float, envelope_bytes: int, now: float) -> None:
        self.full_bits_s = full_bits_s
        self._envelope_bits = 8 * envelope_bytes
        self._bits_s = full_bits_s
        self._at = now
        self._is_late = False
        self._halved_at = now - SHORTEST_OF_S
        self._shortest = deque[tuple[float, float]]()  # times and round trips, both ascending

    @property
    def least_bits_s(self) -> float:
        """It is no lower."""
        return max(LEAST_SHARE * self.full_bits_s, min(LEAST_BITS_S, self.full_bits_s))

    def bits_s(self, now: float) -> float:
        """The rate now."""
        if self._is_late:
            return self.least_bits_s
        if self._bits_s < self.full_bits_s and now > self._at:
            self._bits_s = min(self.full_bits_s, self._bits_s * GROWTH ** min(now - self._at, GROWN_AFTER_S))
        self._at = max(self._at, now)
        return self._bits_s

    def add_round_trip(self, round_trip_s: float, now: float) -> bool:
        """Note the time until the answer to a probe. Returns whether the rate was halved for it."""
        shortest = self._shortest
        while shortest and shortest[0][0] < now - SHORTEST_OF_S:
            shortest.popleft()
        # At a low rate, an envelope alone takes longer than 0.5 s.
        allowed_s = LATER_S + ENVELOPES * self._envelope_bits / self.bits_s(now)
        is_late = bool(shortest) and round_trip_s > shortest[0][1] + allowed_s
        while shortest and shortest[-1][1] >= round_trip_s:
            shortest.pop()
        shortest.append((now, round_trip_s))
        # The answers to questions from before the last halving still show the queue that caused it.
        if not is_late or now - self._halved_at <= round_trip_s:
            return False
        self._halve(now)
        return True

    def set_late(self, now: float, *, is_late: bool) -> None:
        """Note whether answers to echo requests come too late, or not at all.

        Until one comes in time, the rate is the least one, so that the queue empties. Then it is half of that before.
        """
        if is_late and not self._is_late:
            self._halve(now)
        elif self._is_late:  # it does not grow meanwhile
            self._at = max(self._at, now)
        self._is_late = is_late

    def _halve(self, now: float) -> None:
        self._bits_s = max(self.least_bits_s, self.bits_s(now) / 2)
        self._halved_at = now


class SerialNetwork:
    """One serial network."""

    def __init__(self, config: NetworkConfig, number: int, states: Node, stall: StallWatch, log: NetworkLog) -> None:
        assert config.serial is not None, "a serial network has a device"
        self.config = config
        self.name = config.name
        self.number = number
        self.path = Path(number, (SERIAL_HOST, 0))
        self.envelope_limit = limit_at(config.budget_bits_s)
        self.rate = LineRate(config.budget_bits_s, self.envelope_limit + LINE_BYTES, monotonic())
        self._receive: Receive = lambda *_: None
        self._states = states
        self._log = log
        self._on_change: Callable[[], None] = lambda: None
        self._answered_at = 0.0
        self._seconds = deque[tuple[int, int, int, int]](maxlen=RECENT_S + 1)  # totals, one for each second
        # Imported only if configured: a daemon on UDP starts faster and stays smaller.
        from uavlinkd.endpoints.serial_line import SerialLine  # noqa: PLC0415

        self.line = SerialLine(
            config.name,
            config.serial,
            config.budget_bits_s / 8,
            self._on_datagrams,
            partial(self.report_state, is_change=True),
            stall,
        )

    def start(self, receive: Receive, on_change: Callable[[], None]) -> None:
        """Open the device, whenever it is present. ``on_change`` is called after the core got a change."""
        self._receive, self._on_change = receive, on_change
        self.line.start()

    def send(self, datagram: bytes, _address: SocketAddress) -> int:
        """As a socket's ``sendto``."""
        self.line.send(datagram)
        return len(datagram)

    def _on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        address = self.path.address
        self._receive(self.number, [(datagram, address) for datagram in datagrams], now, epoch, 0.0)

    def report_state(self, *, is_change: bool = False) -> None:
        """Report to the core whether the device is open; a change also to the log."""
        now, is_open = monotonic(), self.line.is_open
        if is_change or not is_open:
            self._states.set_socket_state(self.number, now, is_up=is_open)
        if is_change:
            self._log.note(self.presence, now)
            self._on_change()

    def do_housekeeping(self) -> None:
        """Note what was received. Write to the log what it does not say yet about the device."""
        decoder, size = self.line.decoder, self.line.bytes_written + self.line.bytes_received
        self._seconds.append((decoder.line_noise, decoder.datagrams, decoder.reports, size))
        self._log.note(self.presence, monotonic())

    @property
    def presence(self) -> Presence:
        """Whether the device is open."""
        return Presence(hosts=(SERIAL_HOST,)) if self.line.is_open else Presence(reason=self.line.reason)

    @property
    def remedy(self) -> str:
        """What a person can do while it is absent."""
        return meaning_of(self.line.error) or "plug the modem in: the daemon uses it within a second"

    def note_answers(self, peer: Peer, state: PathState, now: float) -> None:
        """Note the last round trip along the line, and echo requests without an answer. Each counts once."""
        if state.round_trip_s is not None and state.answered_at > self._answered_at:
            self._answered_at = state.answered_at
            self.rate.add_round_trip(state.round_trip_s, state.answered_at)
        requests, is_best = peer.echo_requests, state is peer.paths.best and not state.is_off
        is_late = requests.was_late or requests.unanswered >= UNANSWERED
        self.rate.set_late(now, is_late=is_best and is_late)  # the requests go along the best path

    @property
    def recent_reports(self) -> int:
        """RADIO_STATUS frames of the modem in the last seconds: its MAVLINK is not 0."""
        return self.line.decoder.reports - (self._seconds[0][2] if self._seconds else 0)

    @property
    def recent_noise(self) -> tuple[int, int] | None:
        """Damaged pieces and whole datagrams of the last seconds, if the damaged ones are many."""
        if not self._seconds:
            return None
        (noise_before, whole_before, *_), (noise, whole, *_) = self._seconds[0], self._seconds[-1]
        damaged, whole = noise - noise_before, whole - whole_before
        is_much = damaged >= NOISE_PIECES and damaged > NOISE_SHARE * (damaged + whole)
        return (damaged, whole) if is_much else None

    def status(self, now: float) -> dict[str, object]:
        """As plain values, with the keys of every network."""
        line, decoder = self.line, self.line.decoder
        report = decoder.report if self.recent_reports else None
        serial: dict[str, object] = {
            "device": line.url.device,
            "baud": line.url.baud,
            "air_bits_s": self.config.air_bits_s,
            "rate_bits_s": round(self.rate.bits_s(now)),
            "uses_cts": line.uses_cts,
            "line_noise": decoder.line_noise,
            "discarded": {noise.value: count for noise, count in decoder.discarded.items()},
            "discarded_bytes": {noise.value: size for noise, size in decoder.discarded_bytes.items()},
            "cts_held_s": line.cts.total_s,
            "datagrams_received": decoder.datagrams,
            "bytes_received": line.bytes_received,
            "bytes_written": line.bytes_written,
            "failures": dict(line.failures),
            "reports": decoder.reports,
            "reports_inside": decoder.reports_inside,
            "radio": report,
        }
        return network_status(self.config, self.presence, (), serial)


class SerialNetworks:
    """All serial networks, by the numbers that follow those of the UDP sockets."""

    def __init__(
        self,
        configs: Iterable[NetworkConfig],
        first_number: int,
        states: Node,
        stall: StallWatch,
        log: FilteringBoundLogger,
    ) -> None:
        limits = LineLimits()
        self.networks = [
            SerialNetwork(config, first_number + place, states, stall, NetworkLog(config.name, limits, log))
            for place, config in enumerate(configs)
        ]
        self.of_number = {network.number: network for network in self.networks}

    def path_to(self, name: str) -> Path | None:
        """The path along the serial network of this name."""
        return next((network.path for network in self.networks if network.name == name), None)

    def peer_at(self, links: Iterable[PeerLink]) -> dict[int, Peer | None]:
        """The peer of the core at the other end of each line; None during a change."""
        peers = {
            written.network: link.peer for link in links for written in link.config.addresses if written.is_serial
        }
        return {network.number: peers.get(network.name) for network in self.networks}

    def start(self, receive: Receive, on_change: Callable[[], None]) -> None:
        """Open the devices, whenever they are present. ``on_change``: see :meth:`SerialNetwork.start`."""
        for network in self.networks:
            network.start(receive, on_change)

    def budgets(self, now: float) -> dict[int, NetworkBudget]:
        """By the number of the socket. A bucket holds one envelope, so that a modem never gets more at once."""
        return {
            line.number: NetworkBudget(line.config.budget_bits_s, now, line.envelope_limit + LINE_BYTES)
            for line in self.networks
        }

    def follow_rates(
        self, budgets: Mapping[int, NetworkBudget], links: Iterable[PeerLink], now: float
    ) -> dict[int, float]:
        """Adapt the budgets to the answers along the lines. Call it once a second.

        Returns the rates for the core, by the number of the socket, if one of them has changed.
        """
        if not self.networks:
            return {}
        for link in links:
            for state in link.peer.paths.states:
                if (line := self.of_number.get(state.path.socket)) is not None:
                    line.note_answers(link.peer, state, now)
        has_changed = False
        for line in self.networks:
            budget, bits_s = budgets[line.number], line.rate.bits_s(now)
            budget.set_rate(bits_s, now)
            has_changed |= budget.update_core(bits_s)
        return {line.number: budgets[line.number].core_bits_s for line in self.networks} if has_changed else {}

    def do_housekeeping(self) -> None:
        """Note what the lines received. Call it once a second."""
        for network in self.networks:
            network.do_housekeeping()

    @property
    def totals(self) -> dict[str, int]:
        """The number of damaged pieces since the start, by its name in the log. Without such pieces: empty."""
        noise = sum(network.line.decoder.line_noise for network in self.networks)
        return {"line_noise": noise} if noise else {}
