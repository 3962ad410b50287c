"""The serial networks: their devices, as senders and receivers of datagrams beside the UDP sockets.

Each has one socket number, and one path: to the peer at the other end of the line.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final, Protocol

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import NetworkConfig, PeerConfig
from uavlinkd.core.constants import LINE_BYTES
from uavlinkd.core.envelope_limit import limit_at
from uavlinkd.core.path import SERIAL_HOST, Path, SocketAddress
from uavlinkd.core.peer import Peer
from uavlinkd.endpoints.presence import Presence
from uavlinkd.endpoints.reader import Datagrams
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.line_rate import LineRate
from uavlinkd.link.network_log import NetworkLog
from uavlinkd.link.networks import SocketStates
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import meaning_of
from uavlinkd.system.stall import StallWatch

RECENT_S: Final = 10
"""What a line received is judged over this time. A modem that sends RADIO_STATUS does it more often."""
NOISE_PIECES: Final = 10
"""Damaged pieces in :data:`RECENT_S` that are reported, if they are more than :data:`NOISE_SHARE` of all."""
NOISE_SHARE: Final = 0.1
PLUG_IN: Final = "plug the modem in: the daemon uses it within a second"


class Receive(Protocol):
    """Receives the datagrams of one read, as those of a UDP socket."""

    def __call__(self, socket: int, datagrams: Datagrams, now: float, epoch: int, waited_s: float, /) -> None:
        """``socket`` is the number of the network. All datagrams have the same address."""


class Linked(Protocol):
    """A link, as far as it concerns serial networks."""

    config: PeerConfig
    peers: list[Peer]


class SerialNetwork:
    """One serial network."""

    def __init__(
        self,
        config: NetworkConfig,
        number: int,
        receive: Receive,
        states: SocketStates,
        stall: StallWatch,
        log: FilteringBoundLogger,
        limits: LineLimits,
    ) -> None:
        assert config.serial is not None, "a serial network has a device"
        self.config = config
        self.number = number
        self.path = Path(number, (SERIAL_HOST, 0))
        self.envelope_limit = limit_at(config.budget_bits_s)
        self.rate = LineRate(config.budget_bits_s, self.envelope_limit + LINE_BYTES, monotonic())
        self._receive = receive
        self._states = states
        self._log = NetworkLog(config.name, limits, log)
        self._on_change: Callable[[], None] = lambda: None
        self._answered_at = 0.0
        self._unanswered = 0
        self._seconds = deque[tuple[int, int, int]](maxlen=RECENT_S + 1)  # totals, one for each second
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

    @property
    def name(self) -> str:
        """Its name in the configuration."""
        return self.config.name

    def start(self, on_change: Callable[[], None]) -> None:
        """Open the device, whenever it is present. ``on_change`` is called after the core got a change."""
        self._on_change = on_change
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
            self._note(now)
            self._on_change()

    def do_housekeeping(self) -> None:
        """Note what was received. Write to the log what it does not say yet about the device."""
        decoder = self.line.decoder
        self._seconds.append((decoder.line_noise, decoder.datagrams, decoder.reports))
        self._note(monotonic())

    def _note(self, now: float) -> None:
        """Have the log say whether the device is there."""
        line = self.line
        self._log.note(Presence(hosts=(SERIAL_HOST,)) if line.is_open else Presence(reason=line.reason), now)

    def add_round_trip(self, round_trip_s: float, answered_at: float) -> None:
        """Note the last round trip along the line. One that was noted before does not count again."""
        if answered_at > self._answered_at:
            self._answered_at = answered_at
            self.rate.add_round_trip(round_trip_s, answered_at)

    def add_unanswered(self, total: int, now: float, *, is_asked: bool) -> None:
        """Note the total of the peer's unanswered echo requests. ``is_asked``: they went along this line."""
        if is_asked and total > self._unanswered:
            self.rate.add_unanswered(total - self._unanswered, now)
        self._unanswered = total

    def bits_s(self, now: float) -> float:
        """The rate at which this end sends now. The line is written at it from now on."""
        bits_s = self.rate.bits_s(now)
        self.line.set_rate(bits_s / 8)
        return bits_s

    @property
    def recent_reports(self) -> int:
        """RADIO_STATUS frames of the modem in the last seconds: its MAVLINK is not 0."""
        return self.line.decoder.reports - (self._seconds[0][2] if self._seconds else 0)

    @property
    def recent_noise(self) -> tuple[int, int] | None:
        """Damaged pieces and whole datagrams of the last seconds, if the damaged ones are many."""
        if not self._seconds:
            return None
        (noise_before, whole_before, _), (noise, whole, _) = self._seconds[0], self._seconds[-1]
        damaged, whole = noise - noise_before, whole - whole_before
        is_much = damaged >= NOISE_PIECES and damaged > NOISE_SHARE * (damaged + whole)
        return (damaged, whole) if is_much else None

    def status(self, now: float) -> dict[str, object]:
        """As plain values, with the keys of every network."""
        line, decoder = self.line, self.line.decoder
        report = decoder.report if self.recent_reports else None
        return {
            "interface": None,
            "address": None,
            "is_metered": False,
            "budget_bits_s": self.config.budget_bits_s,
            "is_present": line.is_open,
            "absent_because": line.reason or None,
            "addresses": [SERIAL_HOST] if line.is_open else [],
            "ports": [],
            "serial": {
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
                "radio": None
                if report is None
                else {
                    "rssi": report.rssi,
                    "remrssi": report.remrssi,
                    "txbuf": report.txbuf,
                    "noise": report.noise,
                    "remnoise": report.remnoise,
                    "rxerrors": report.rxerrors,
                    "fixed": report.fixed,
                },
            },
        }


class SerialNetworks:
    """All serial networks, by the numbers that follow those of the UDP sockets."""

    def __init__(
        self,
        configs: Iterable[NetworkConfig],
        first_number: int,
        receive: Receive,
        states: SocketStates,
        stall: StallWatch,
        log: FilteringBoundLogger,
    ) -> None:
        limits = LineLimits()
        self.networks = [
            SerialNetwork(config, first_number + place, receive, states, stall, log, limits)
            for place, config in enumerate(configs)
        ]
        self.of_number = {network.number: network for network in self.networks}

    def path_to(self, name: str) -> Path | None:
        """The path along the serial network of this name."""
        return next((network.path for network in self.networks if network.name == name), None)

    def peers_at(self, links: Iterable[Linked]) -> dict[int, list[Peer]]:
        """The peers of the core at the other end of each line. The list is empty during a change."""
        return {
            network.number: [
                peer
                for link in links
                if any(written.is_serial and written.network == network.name for written in link.config.addresses)
                for peer in link.peers
            ]
            for network in self.networks
        }

    def start(self, on_change: Callable[[], None]) -> None:
        """Open the devices, whenever they are present. ``on_change``: see :meth:`SerialNetwork.start`."""
        for network in self.networks:
            network.start(on_change)

    def report_absent(self) -> None:
        """Report the devices that are not open. Call it after other paths were set: the core knows states by path."""
        for network in self.networks:
            network.report_state()

    def do_housekeeping(self) -> None:
        """Note what the lines received. Call it once a second."""
        for network in self.networks:
            network.do_housekeeping()

    def close(self) -> None:
        """Close the devices."""
        for network in self.networks:
            network.line.close()

    @property
    def totals(self) -> dict[str, int]:
        """The number of damaged pieces since the start, by its name in the log. Without such pieces: empty."""
        noise = sum(network.line.decoder.line_noise for network in self.networks)
        return {"line_noise": noise} if noise else {}

    def absent(self) -> dict[str, str]:
        """The serial networks that are absent now, each with the reason, and what a person can do."""
        lines = {network.name: network.line for network in self.networks if not network.line.is_open}
        return {f"{name} ({line.reason})": meaning_of(line.error) or PLUG_IN for name, line in lines.items()}
