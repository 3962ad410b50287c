"""The local endpoints of a daemon: opened, changed and closed as the configuration says, with their policies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from uavlinkd.config import Config, EndpointConfig
from uavlinkd.config.changes import ConfigChanges
from uavlinkd.endpoints.ports import Endpoint, LocalPort
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.opening import open_first, open_new
from uavlinkd.link.switch import Switch
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import Policy, compile_policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.radio_status import LinkFigures, RadioStatusSource
from uavlinkd.mavlink.status_text import Note, StatusTextSource
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch


class OnFrames(Protocol):
    """Receives the frames of a local client, as :meth:`uavlinkd.endpoints.ports.PortHandler.on_frames`."""

    def __call__(
        self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0
    ) -> None: ...


class LocalEndpoints:
    """Opens and closes the endpoints, adds their clients to the switch, and sends them RADIO_STATUS."""

    def __init__(self, name: str, switch: Switch, events: EventLog, stall: StallWatch, on_frames: OnFrames) -> None:
        """``name``: the daemon, as the source of its own frames."""
        self.endpoints: list[Endpoint] = []
        self.policies: dict[str, Policy] = {}
        """By the endpoint's name."""
        self.stall = stall
        self.on_frames = on_frames
        self._switch = switch
        self._events = events
        self._radio_status: dict[str, RadioStatusSource] = {}
        self._status_text: dict[str, StatusTextSource] = {}
        self._own = Source(name, compile_policy({}, is_local=True).incoming)
        self._gather_s = 0.0

    @property
    def judged(self) -> Iterator[tuple[Endpoint, Policy]]:
        """Each endpoint with its policy."""
        return ((endpoint, self.policies[endpoint.name]) for endpoint in self.endpoints)

    # From the configuration.

    def open(self, configs: Sequence[EndpointConfig]) -> None:
        """Bind the endpoints of a daemon that starts.

        Raises:
            BindError: if the daemon cannot listen on an address. The message names the key.
        """
        for config in configs:
            self.endpoints.append(open_first(config, self))

    def start(self, configs: Sequence[EndpointConfig]) -> None:
        """Start the endpoints that :meth:`open` has bound."""
        for endpoint, config in zip(self.endpoints, configs, strict=True):
            self._start(endpoint, config)

    def open_new(self, config: Config, before: Config, changes: ConfigChanges) -> list[Endpoint]:
        """Bind the endpoints that a new configuration adds. :meth:`add` starts them.

        Raises:
            ConfigError: if one cannot be opened. Then none is, and the others are as they were.
        """
        urls = {endpoint.name: endpoint.url for endpoint in before.endpoints}
        leaving = {
            urls[endpoint.name]: endpoint for endpoint in self.endpoints if endpoint.name in changes.closed_endpoints
        }
        return open_new(config, changes.opened_endpoints, leaving, self)

    def add(self, endpoint: Endpoint, config: EndpointConfig) -> None:
        """Start an endpoint that :meth:`open_new` has bound."""
        self.endpoints.append(endpoint)
        self._start(endpoint, config)

    def change(self, config: EndpointConfig) -> None:
        """Apply other rules to an endpoint. Its clients stay connected."""
        policy = self.policies[config.name] = config.make_policy()
        for endpoint in self.endpoints:
            if endpoint.name == config.name:
                for port in endpoint.ports:
                    self._switch.set_policy(port, policy)
        self._radio_status.pop(config.name, None)
        if config.radio_status:
            self._radio_status[config.name] = RadioStatusSource()
        self._status_text.pop(config.name, None)
        if config.status_text:
            self._status_text[config.name] = StatusTextSource()

    def close_one(self, name: str) -> None:
        """Close an endpoint that is no longer configured."""
        endpoint = next(endpoint for endpoint in self.endpoints if endpoint.name == name)
        self.endpoints.remove(endpoint)
        for port in endpoint.ports:
            self._switch.remove(port)
        endpoint.close()
        del self.policies[name]
        self._events.forget_endpoint(name)
        self._radio_status.pop(name, None)
        self._status_text.pop(name, None)

    def close(self) -> None:
        """Close all endpoints."""
        for endpoint in self.endpoints:
            endpoint.close()

    def gather(self, seconds: float) -> None:
        """From now on, frames may wait this long before they are read: all peers make them wait anyway."""
        self._gather_s = seconds
        for endpoint in self.endpoints:
            endpoint.gather(seconds)

    def _start(self, endpoint: Endpoint, config: EndpointConfig) -> None:
        self.change(config)
        endpoint.gather(self._gather_s)
        endpoint.start()

    # Reports of the endpoints.

    def on_port_opened(self, port: LocalPort) -> None:
        """A local client connected: accept frames from it, and send frames to it."""
        self._events.write_client("client_connected", port.endpoint.name, port.name, monotonic())
        self._switch.add(port, self.policies[port.endpoint.name])

    def on_port_closed(self, port: LocalPort) -> None:
        """A local client disconnected."""
        self._events.write_client("client_disconnected", port.endpoint.name, port.name, monotonic())
        self._switch.remove(port)

    def on_port_silent(self, port: LocalPort) -> None:
        """A local client is silent and may have gone."""
        self._switch.set_silent(port, is_silent=True)

    def on_port_active(self, port: LocalPort) -> None:
        """A silent local client sends again."""
        self._switch.set_silent(port, is_silent=False)

    # Time.

    def do_housekeeping(self, radio: LinkFigures | None, now: float) -> None:
        """Forget clients that have gone, log silent endpoints, and send RADIO_STATUS. Call it once a second."""
        for endpoint in self.endpoints:
            endpoint.do_housekeeping(now)
            self._events.note_endpoint(endpoint)
            source = self._radio_status.get(endpoint.name)
            if source is not None and radio is not None:
                frames = split_payload(source.frame(radio), SplitCounters())
                for port in endpoint.ports:
                    endpoint.write(port, frames, self._own, now)

    def write_note(self, note: Note | None, now: float) -> None:
        """Send a text to the clients of the endpoints that have ``status_text``. It goes nowhere else."""
        if note is None:
            return
        for endpoint in self.endpoints:
            source = self._status_text.get(endpoint.name)
            if source is not None:
                raw = source.frame(note)
                self._switch.router.note_own(raw, now)
                frames = split_payload(raw, SplitCounters())
                for port in endpoint.ports:
                    endpoint.write(port, frames, self._own, now)
