"""The local endpoints of a daemon, with their policies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple, TypeVar

from uavlinkd.config.model import EndpointConfig, SigningConfig
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.peer_link import PeerLink, radio_figures
from uavlinkd.daemon.switch import Switch
from uavlinkd.io.ports import Endpoint, LocalPort, PortHandler
from uavlinkd.io.sockets import BindError, udp_socket
from uavlinkd.io.udp import UdpClient, UdpServer
from uavlinkd.io.url import EndpointKind, NetworkUrl, SerialUrl, StationUrl
from uavlinkd.mavlink.dialect import IDS, KINDS, UNKNOWN, command_name, name_of
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.own_frames import (
    TEXT_BYTES,
    Note,
    RadioStatusSource,
    StatusTextSource,
    TextSeverity,
)
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.policy.gate import REFUSALS, Refusal
from uavlinkd.mavlink.routing import SystemComponent
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.settings import Class
from uavlinkd.protocol.wire import Refused
from uavlinkd.system.guard import run
from uavlinkd.system.stall import StallWatch

# TCP and serial are imported only if configured: a daemon on UDP starts faster and stays smaller.
# ruff: noqa: PLC0415

S = TypeVar("S", RadioStatusSource, StatusTextSource)


def open_endpoint(config: EndpointConfig, handler: PortHandler) -> Endpoint:
    """Open the endpoint: a socket that listens is bound. It begins to work when it is started.

    Raises BindError if the daemon cannot listen on its address.
    """
    match config.url:
        case NetworkUrl(EndpointKind.UDPIN, address):
            return UdpServer(config.name, udp_socket(address, may_come_later=True), handler)
        case NetworkUrl(EndpointKind.UDPOUT, address):
            return UdpClient(config.name, address, handler)
        case NetworkUrl(EndpointKind.TCPIN, address):
            from uavlinkd.io.tcp import TcpServer, tcp_listener

            return TcpServer(config.name, tcp_listener(address), handler)
        case NetworkUrl(EndpointKind.TCP, address):
            from uavlinkd.io.tcp import TcpClient

            return TcpClient(config.name, address, handler)
        case SerialUrl() as url:
            from uavlinkd.io.serial import SerialEndpoint

            return SerialEndpoint(config.name, url, handler)
    raise AssertionError(f"no endpoint is of the kind {config.url.kind}")


class LocalEndpoints:
    """Opens the endpoints, adds their clients to the switch, and sends them RADIO_STATUS."""

    def __init__(self, name: str, switch: Switch, journal: DaemonJournal, stall: StallWatch) -> None:
        """``name``: the daemon, as the source of its own frames."""
        self.endpoints: list[Endpoint] = []
        self.policies: dict[str, Policy] = {}
        """By the endpoint's name."""
        self.stall = stall
        self.open_station: Callable[[EndpointConfig, PortHandler], Endpoint]
        """Opens the endpoint of a station, if the file has any."""
        self.sign: Callable[[Endpoint, SigningConfig], object]
        """Makes an endpoint sign, if the file has a key for any."""
        self.on_frames: Callable[..., None]
        """Of :class:`uavlinkd.io.ports.PortHandler`: :meth:`.Line.forward`, without a call in between."""
        self._switch = switch
        self._journal = journal
        self._radio: dict[Endpoint, RadioStatusSource] = {}
        self._texts: dict[Endpoint, StatusTextSource] = {}
        self._notes = PilotNotes(switch.router.addresses)
        self._own = Source(name, Policy({}, is_local=True).incoming)

    # From the configuration.

    def open(self, configs: Iterable[EndpointConfig]) -> None:
        """Bind the endpoints. :meth:`start` starts them.

        Raises BindError: one of them cannot be opened. The message names the key.
        """
        for config in configs:
            try:
                is_station = isinstance(config.url, StationUrl)
                self.endpoints.append((self.open_station if is_station else open_endpoint)(config, self))
            except (BindError, OSError) as error:
                raise BindError(f"endpoint.url ({config.name}): {error}") from None
            if config.signing is not None:
                self.sign(self.endpoints[-1], config.signing)
            self.policies[config.name] = config.make_policy()
            if config.radio_status:
                self._radio[self.endpoints[-1]] = RadioStatusSource()
            if config.status_text:
                self._texts[self.endpoints[-1]] = StatusTextSource()

    def start(self) -> None:
        """Start the endpoints."""
        for endpoint in self.endpoints:
            endpoint.start()

    def set_policy(self, name: str, policy: Policy) -> None:
        """Apply another policy to an endpoint. Its clients stay connected."""
        self.policies[name] = policy
        for endpoint in self.endpoints:
            if endpoint.name == name:
                for port in endpoint.ports:
                    self._switch.set_policy(port, policy)

    def close(self) -> None:
        """Close all endpoints."""
        for endpoint in self.endpoints:
            endpoint.close()

    def gather(self, seconds: float) -> None:
        """From now on, frames may wait this long before they are read: all peers make them wait anyway."""
        for endpoint in self.endpoints:
            endpoint.gather(seconds)

    # Reports of the endpoints.

    def on_port_opened(self, port: LocalPort) -> None:
        """A local client connected: accept frames from it, and send frames to it."""
        self._switch.add(port, self.policies[port.endpoint.name])
        run(self._journal.write_client, "client_connected", port.endpoint.name, port.name)

    def on_port_closed(self, port: LocalPort) -> None:
        """A local client disconnected."""
        run(self._journal.write_client, "client_disconnected", port.endpoint.name, port.name)
        self._switch.remove(port)

    def on_port_silent(self, port: LocalPort) -> None:
        """A local client is silent and may have gone."""
        self._switch.router.set_silent(port, is_silent=True)

    def on_port_active(self, port: LocalPort) -> None:
        """A silent local client sends again."""
        self._switch.router.set_silent(port, is_silent=False)

    # Time.

    def do_housekeeping(self, links: Sequence[PeerLink], now: float) -> None:
        """Forget clients that have gone, and send RADIO_STATUS and texts about links. Call it once a second."""
        for endpoint in self.endpoints:
            run(endpoint.do_housekeeping, now)
        if self._radio and (figures := radio_figures(links)) is not None:
            self._write(self._radio, lambda source: source.frame(figures), now)
        if self._texts and (note := self._notes.next(links, now)) is not None:
            self._write(self._texts, lambda source: source.frame(note), now)

    def _write(self, sources: Mapping[Endpoint, S], frame_of: Callable[[S], bytes], now: float) -> None:
        """Send a frame of each source to the clients of its endpoint. It goes nowhere else."""
        for endpoint, source in sources.items():
            self.send_own(endpoint, frame_of(source), now)

    def send_own(self, endpoint: Endpoint, raw: bytes, now: float) -> None:
        """Send a frame of the daemon's own to the clients of an endpoint."""
        self._switch.router.sendings.note_own(raw, endpoint.ports, now)
        frames = split_payload(raw, SplitCounters())
        for port in endpoint.ports:
            port.send(frames, self._own, now, 0.0)


# What the pilot should know about the links, as short texts for the ground station: at most one a second. Texts wait,
# the most severe first, then the latest. One that waited too long, or that another one made untrue, is dropped.

INTERVAL_S: Final = 1.0
"""Between two texts, over all peers."""
WAIT_S: Final = 10.0
"""A text that waited for longer is dropped."""
REFUSAL_INTERVAL_S: Final = 10.0
"""Between two texts about what one peer refuses, and between two about what is withheld from it: a hostile peer can
invent refusals, and must not hide this end's own ones."""

_AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1
_STATUSTEXT: Final = IDS["STATUSTEXT"]
_LABELS: Final = {400: "(DIS)ARM"}
_LABEL_CHARACTERS: Final = 20
_CLAIM: Final = "refused"
"""The topic of what a peer claims: its texts come after this end's own ones."""
_REASONS: Final = {
    Refusal.MESSAGE_NOT_ALLOWED: "role or list",
    Refusal.COMMAND_NOT_ALLOWED: "role or list",
    Refusal.FOREIGN_SYSTEM: "system id",
    Refusal.RATE_LIMITED: "too many",
}


class _Waiting(NamedTuple):
    severity: TextSeverity
    text: str
    since: float
    link: PeerLink


class _Seen:
    """What was observed of one peer."""

    def __init__(self, link: PeerLink, now: float) -> None:
        self.link = link
        self.is_up = link.peer.is_up
        self.is_lost = False
        """Whether the loss of the link was reported, or is about to be."""
        self.is_unverified = False
        self.claims_until = -NEVER
        self.quiet_until = {"withheld": now, _CLAIM: now}
        self.system: int | None = None
        """Of the vehicle behind the link, when it was seen last."""


class PilotNotes:
    """Finds what is new, once a second. ``addresses``: those that were received behind a peer."""

    def __init__(self, addresses: Callable[[PeerLink], list[SystemComponent]]) -> None:
        self._addresses = addresses
        self._seen: dict[str, _Seen] = {}
        self._waiting: dict[tuple[str, str], _Waiting] = {}
        self._next_at = 0.0

    def next(self, links: Iterable[PeerLink], now: float) -> Note | None:
        """The text to send now, if there is one. Call it about once a second."""
        present = {link.name: link for link in links}
        self._seen = {name: seen for name, seen in self._seen.items() if present.get(name) is seen.link}
        for name, link in present.items():
            if name in self._seen:
                self._observe(self._seen[name], now)
            else:
                self._seen[name] = _Seen(link, now)
        self._waiting = {
            key: waiting
            for key, waiting in self._waiting.items()
            if key[0] in present and now - waiting.since <= WAIT_S
        }
        return None if now < self._next_at else self._pop(now)

    def _pop(self, now: float) -> Note | None:
        def turn(key: tuple[str, str]) -> tuple[TextSeverity, bool, float]:
            return self._waiting[key].severity, key[1] == _CLAIM, -self._waiting[key].since

        for key in sorted(self._waiting, key=turn):
            severity, text, _, link = self._waiting[key]
            system = self._seen[link.name].system
            if system is not None:  # a ground station shows only texts of a vehicle that it knows
                del self._waiting[key]
                self._next_at = now + INTERVAL_S
                return Note(severity, text, system)
        return None

    def _observe(self, seen: _Seen, now: float) -> None:
        link = seen.link
        name, peer = link.name, link.peer
        seen.system = _vehicle(self._addresses(link)) or seen.system
        if seen.is_up != peer.is_up:
            seen.is_up = peer.is_up
            if not peer.is_up:
                seen.is_lost = True
                self._put(link, "link", TextSeverity.CRITICAL, f"link to {name} lost", now)
            elif seen.is_lost:
                seen.is_lost = False
                self._put(link, "link", TextSeverity.NOTICE, f"link to {name} restored", now)
        if seen.is_unverified != (peer.unverified_since is not None):
            seen.is_unverified = not seen.is_unverified
            if seen.is_unverified:
                text = f"link to {name}: age of commands unverified"
                self._put(link, "freshness", TextSeverity.ERROR, text, now)
            else:
                self._waiting.pop((name, "freshness"), None)
        for topic, text in (("withheld", _withheld_here(seen)), (_CLAIM, _refused_there(seen))):
            if text and now >= seen.quiet_until[topic]:
                seen.quiet_until[topic] = now + REFUSAL_INTERVAL_S
                self._put(link, topic, TextSeverity.WARNING, text, now)
        seen.claims_until = now

    def _put(self, link: PeerLink, topic: str, severity: TextSeverity, text: str, now: float) -> None:
        self._waiting[link.name, topic] = _Waiting(severity, text, now, link)


def _refused_there(seen: _Seen) -> str:
    """The latest claim since the last look, if the pilot needs to know it."""
    for claim in seen.link.peer.claims.refusals():
        if claim.changed_at >= seen.claims_until and _is_wanted(claim.refused):
            reason = _REASONS.get(REFUSALS.get(claim.refused.reason, Refusal.HIDDEN_FRAME), "policy")
            return _fit(seen.link.name, f": {_label(claim.refused)} withheld there, {reason}")
    return ""


def _withheld_here(seen: _Seen) -> str:
    link = seen.link
    role = link.config.policy.get("role")
    reason = "role or list" if role is None else f"role {role}"
    for refused in link.policy.outgoing.changed_totals():
        if _is_wanted(refused):
            return _fit(link.name, f": {_label(refused)} withheld here, {reason}")
    return ""


def _is_wanted(refused: Refused) -> bool:
    """Whether a pilot sent it on purpose: a command, mission, parameter or setpoint, not a report."""
    kind = KINDS.get(refused.message, UNKNOWN)
    is_order = kind.cls is Class.CRITICAL and not kind.may_be_old
    return bool(refused.command) or (is_order and refused.message != _STATUSTEXT)


def _label(refused: Refused) -> str:
    if not refused.command:
        return name_of(refused.message)[:_LABEL_CHARACTERS]
    name = command_name(refused.command).removeprefix("MAV_CMD_")
    return _LABELS.get(refused.command, name.removeprefix("DO_").removeprefix("NAV_")[:_LABEL_CHARACTERS])


def _fit(name: str, rest: str) -> str:
    """The name is cut, if both are too long together."""
    return name[: max(0, TEXT_BYTES - len(rest))] + rest


def _vehicle(addresses: list[SystemComponent]) -> int | None:
    """The first autopilot's system, else the first system."""
    autopilots = [system for system, component in addresses if component == _AUTOPILOT]
    return next(iter(autopilots or (system for system, _ in addresses)), None)
