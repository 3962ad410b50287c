"""The serial networks: their devices, as senders and receivers of datagrams beside the UDP sockets.

Each has one socket number, and one path: to the peer at the other end of the line. The file says what its radio
carries.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import NetworkConfig, PeerAddress
from uavlinkd.daemon.features import AddSender, PathKind, Reachable
from uavlinkd.daemon.networks import NetworkBudget, NetworkLog, Receive, network_status
from uavlinkd.io.sockets import Presence
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol.constants import LINE_BYTES
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import SERIAL_HOST, Path, SocketAddress
from uavlinkd.protocol.path_measures import limit_at
from uavlinkd.serial.serial_line import SerialLine
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import meaning_of
from uavlinkd.system.stall import StallWatch

RECENT_S: Final = 10
"""What a line received is judged over this time. A modem that sends RADIO_STATUS does it more often."""
NOISE_PIECES: Final = 10
"""Damaged pieces in :data:`RECENT_S` that are reported, if they are more than :data:`NOISE_SHARE` of all."""
NOISE_SHARE: Final = 0.1
FULL_BELOW: Final = 20
"""A modem's send buffer with less free room than this, in per cent, is full."""
BACK_OFF_S: Final = 2
"""A report of the modem counts for this time: the modem sends one a second."""
BACKED_OFF: Final = 0.25
"""While the buffer is full, this end sends at this part of the rate, so that the buffer empties."""


class SerialNetwork:
    """One serial network."""

    def __init__(
        self, config: NetworkConfig, add: AddSender, states: Node, stall: StallWatch, log: NetworkLog
    ) -> None:
        assert config.serial is not None, "a serial network has a device"
        self.config = config
        self.name = config.name
        envelope_limit = limit_at(config.budget_bits_s)
        # A bucket holds one envelope, so that a modem never gets more at once.
        self.budget = NetworkBudget(config.budget_bits_s, monotonic(), envelope_limit + LINE_BYTES)
        self.number = add(self.send, self.budget, envelope_limit)
        self.path = Path(self.number, (SERIAL_HOST, 0))
        self._receive: Receive = lambda *_: None
        self._states = states
        self._log = log
        self._on_change: Callable[[], None] = lambda: None
        self._full_s = 0
        """For so many seconds more the modem's send buffer counts as full."""
        self._seconds = deque[tuple[int, int, int]](maxlen=RECENT_S + 1)  # totals, one for each second
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
        decoder = self.line.decoder
        self._full_s = max(0, self._full_s - 1)
        if decoder.report is not None and decoder.reports > (self._seconds[-1][2] if self._seconds else 0):
            self._full_s = BACK_OFF_S if decoder.report["txbuf"] < FULL_BELOW else 0
        self._seconds.append((decoder.line_noise, decoder.datagrams, decoder.reports))
        self._log.note(self.presence, monotonic())

    @property
    def presence(self) -> Presence:
        """Whether the device is open."""
        return Presence(hosts=(SERIAL_HOST,)) if self.line.is_open else Presence(reason=self.line.reason)

    @property
    def remedy(self) -> str:
        """What a person can do while it is absent."""
        return meaning_of(self.line.error) or "plug the modem in: the daemon uses it within a second"

    @property
    def rate_bits_s(self) -> float:
        """The rate at which this end sends: less while the modem says that its send buffer is full."""
        return (BACKED_OFF if self._full_s else 1.0) * self.config.budget_bits_s

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

    def status(self) -> dict[str, object]:
        """As plain values, with the keys of every network."""
        line, decoder = self.line, self.line.decoder
        report = decoder.report if self.recent_reports else None
        serial: dict[str, object] = {
            "device": line.url.device,
            "baud": line.url.baud,
            "air_bits_s": self.config.air_bits_s,
            "rate_bits_s": round(self.rate_bits_s),
            "line_noise": decoder.line_noise,
            "discarded": {noise.value: count for noise, count in decoder.discarded.items()},
            "discarded_bytes": {noise.value: size for noise, size in decoder.discarded_bytes.items()},
            "datagrams_received": decoder.datagrams,
            "bytes_received": line.bytes_received,
            "bytes_written": line.bytes_written,
            "failures": dict(line.failures),
            "reports": decoder.reports,
            "radio": report,
        }
        return network_status(self.config, self.presence, (), serial)


class SerialNetworks(PathKind):
    """All serial networks, by the numbers that follow those of the UDP sockets."""

    def __init__(
        self, configs: Iterable[NetworkConfig], states: Node, stall: StallWatch, log: FilteringBoundLogger
    ) -> None:
        self.networks: list[SerialNetwork] = []
        self._configs = configs
        self._states = states
        self._stall = stall
        self._log = log

    def open(self, add: AddSender) -> None:
        """Reserve the numbers. The devices are opened later, whenever they are present."""
        limits = LineLimits()
        for config in self._configs:
            log = NetworkLog(config.name, limits, self._log)
            self.networks.append(SerialNetwork(config, add, self._states, self._stall, log))

    def start(self, receive: Receive, on_change: Callable[[], None], on_room: Callable[[], None]) -> None:
        """Open the devices. ``on_change``: see :meth:`SerialNetwork.start`."""
        for network in self.networks:
            network.start(receive, on_change)

    def path_to(self, written: PeerAddress) -> Path | None:
        """The path along the serial network that the address names."""
        name = written.network if written.is_serial else None
        return next((network.path for network in self.networks if network.name == name), None)

    def network_name(self, number: int) -> str | None:
        """The name of the serial network with this number."""
        return next((network.name for network in self.networks if network.number == number), None)

    def follow_links(self, links: Iterable[Reachable]) -> None:
        """Report to the core which peer is at the other end of each line; None during a change."""
        peers = {
            written.network: link.peer for link in links for written in link.config.addresses if written.is_serial
        }
        ends = {network.number: peers.get(network.name) for network in self.networks}
        self._states.facts.set_point_to_point(ends)

    def report_state(self) -> None:
        """Report the devices that are not open."""
        for network in self.networks:
            network.report_state()

    def do_housekeeping(self) -> None:
        """Note what the lines received, and adapt the budgets to what the modems report."""
        now, has_changed = monotonic(), False
        for network in self.networks:
            network.do_housekeeping()
            network.budget.set_rate(network.rate_bits_s, now)
            has_changed |= network.budget.update_core(network.rate_bits_s)
        if has_changed:
            self._states.set_rates({network.number: network.budget.core_bits_s for network in self.networks}, now)

    def close(self) -> None:
        """Close the devices."""
        for network in self.networks:
            network.line.close()
