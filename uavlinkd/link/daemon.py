"""The shell: sockets, one timer, signals. It turns wake-ups into calls of the core, and outputs into sends and logs.

There is no task, queue, lock or ``await`` between reading a frame and sending it, but for what a slow radio's budget
or a slow program makes wait.
"""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.config import Config, ConfigError
from uavlinkd.config import Endpoint as EndpointConfig
from uavlinkd.config import Peer as PeerConfig
from uavlinkd.config.changes import compare
from uavlinkd.config.reader import read_config
from uavlinkd.ops.control import ControlServer
from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output
from uavlinkd.link.opening import open_first, open_new
from uavlinkd.endpoints.ports import Endpoint, LocalPort
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.intake import Intake
from uavlinkd.link.key_change import Graces, link_name
from uavlinkd.ops.log import DropSummary
from uavlinkd.mavlink.classes import screen
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import Policy, compile_policy
from uavlinkd.mavlink.radio_status import INTERVAL_S, RadioStatusSource
from uavlinkd.mavlink.routing import Router
from uavlinkd.link.peer_link import PeerLink, radio_figures
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.ops.recorder import FROM_PEER, Recorder
from uavlinkd.ops.sdnotify import Supervisor
from uavlinkd.system.stall import StallWatch
from uavlinkd.link.status import daemon_status
from uavlinkd.link.switch import Switch
from uavlinkd.link.turns import cost_of

if TYPE_CHECKING:
    from uavlinkd.ops.metrics_server import MetricsServer

LOOP_TICK_S = 0.001
"""A loop may fire a timer up to one tick of its clock early; this much later it is not early."""
GATHER_AT_MOST_S = 0.005
"""Where every peer's frames wait for company, but no longer than this, programs are read only so often: wake-ups are
what costs. A longer wait is the queues', which know what is urgent."""
HOUSEKEEPING_S = INTERVAL_S
"""How often links are measured, and idle programs forgotten."""


class Daemon:
    """One uavlinkd: the peers on one side, the local MAVLink endpoints on the other.

    Use :meth:`run`; or :meth:`start`, and :meth:`stop` in the end.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.log = structlog.get_logger().bind(daemon=config.name)
        now = monotonic()
        self.node = Node(config.private_key, os.urandom, now, config.previous_private_key, screen=screen)
        self.endpoints: list[Endpoint] = []
        self.endpoint_policies: dict[str, Policy] = {}
        self.links: dict[str, PeerLink] = {}
        self._graces = Graces()
        routing = config.routing
        router = Router[PeerLink | LocalPort](relays=routing.relay, floods_unknown=routing.unknown_targets == "flood")
        self._loop = asyncio.get_running_loop()
        self._drops = DropSummary(self.log)
        self.switch = Switch(router, self._drops.add_refused)
        self._events = EventLog(self.log)
        self.stall = StallWatch(now, self._on_pause)
        self._intake = Intake(self.node, self.stall, self._perform, self._on_peer_frames, self._settle)
        self.peer_sockets = PeerSockets(self._intake.on_arrived, self.stall, self._drops, self.log)
        self._radio_status: dict[str, RadioStatusSource] = {}
        # Of the frames that this daemon makes itself.
        self._own = Source(config.name, compile_policy({}, is_local=True).incoming)
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER
        self._housekeeping_at = now + HOUSEKEEPING_S
        self._gather_s = 0.0
        self._can_wait = False  # whether any peer's frames ever wait
        self._reloading = asyncio.Lock()
        self._hangups: set[asyncio.Task[None]] = set()
        self._control: ControlServer | None = None
        self._metrics: MetricsServer | None = None
        self.recorder: Recorder | None = None
        self.supervisor = Supervisor(os.environ, os.getpid())

    # Life.

    async def run(self) -> None:
        """Start, work until SIGTERM or SIGINT, and end cleanly.

        Raises:
            BindError: where an address cannot be listened on; nothing has been started then.
            ControlError: likewise for the control socket.
        """
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, stop.set)
        self._loop.set_exception_handler(self._drops.on_loop_failure)
        self._loop.add_signal_handler(signal.SIGHUP, self._on_hangup)
        await self.start()
        try:
            await stop.wait()
        finally:
            await self.stop()

    async def start(self) -> None:
        """Bind every socket, then let things happen.

        Raises:
            BindError: where an address cannot be listened on.
            ControlError: where the control socket cannot be made.
        """
        try:
            self.peer_sockets.open(self.config.listen)
            for each in self.config.endpoints:
                self.endpoints.append(open_first(each, self))
            if self.config.metrics is not None:
                from uavlinkd.ops.metrics_server import serve_metrics  # noqa: PLC0415  where asked for

                self._metrics = await serve_metrics(self.config.metrics, lambda: daemon_status(self, monotonic()))
            if self.config.control_socket is not None:
                self._control = ControlServer(self.config.control_socket, self._answer)
                await self._control.start()
        except Exception:
            self._close_sockets()
            raise
        if self.config.recording is not None:
            self.recorder = Recorder(self.config.recording, self.log)
        for peer in self.config.peers:
            self._add_peer(peer)
        self.peer_sockets.start()
        for endpoint, config in zip(self.endpoints, self.config.endpoints, strict=True):
            self._start_endpoint(endpoint, config)
        self._warn()
        self.log.info(
            "daemon_started",
            listen=[str(each) for each in self.peer_sockets.addresses],
            endpoints={each.name: str(each.url) for each in self.config.endpoints},
            peers=list(self.links),
        )
        self._arm()
        self.supervisor.ready()

    async def stop(self) -> None:
        """Tell the peers, and close everything."""
        self.supervisor.stopping()
        if self._timer is not None:
            self._timer.cancel()
        self._intake.clear()
        self._perform(self.node.close(monotonic()))
        self._close_sockets()
        if self._control is not None:
            await self._control.stop()
        self._drops.flush(NEVER)
        for link in self.links.values():
            self._events.disturbed(link.peer.name, link.disturbances(monotonic()), NEVER)
        if self.recorder is not None:
            self.recorder.stop(monotonic())
        self.log.info("daemon_stopped")

    def _close_sockets(self) -> None:
        self.peer_sockets.close()
        for endpoint in self.endpoints:
            endpoint.close()
        if self._metrics is not None:
            self._metrics.stop()

    def _warn(self) -> None:
        for warning in self.config.warnings:
            self.log.warning("configuration_warning", warning=warning)

    # What may change while it runs.

    async def reload(self) -> None:
        """Read the configuration again and make it so, without touching what did not change.

        One at a time, in the order in which they were asked for: what the last one reads stays in force.

        Raises:
            ConfigError: the new file is wrong, changes what only a restart can, or has an endpoint that cannot be
                opened; the old one stays in force, whole.
        """
        async with self._reloading:
            self.supervisor.reloading()
            try:
                await self._reload()
            except BaseException:
                self.supervisor.ready("the new configuration was refused")
                raise
            self.supervisor.ready()

    async def _reload(self) -> None:
        try:
            config = await read_config(self.config.path)
            changes = compare(self.config, config)
            urls = {each.name: each.url for each in self.config.endpoints}
            leaving = {urls[each.name]: each for each in self.endpoints if each.name in changes.closed_endpoints}
            opened = open_new(config, changes.opened_endpoints, leaving, self)
        except ConfigError as error:
            self.log.error("configuration_refused", problems=str(error).splitlines())
            raise
        self._graces.follow(self.config.peers, config.peers)
        self.config = config
        if config.previous_private_key is None:
            for link in self.links.values():
                link.give_up_ours(monotonic())
            self.node.forget_previous_key()
        for name in changes.removed_peers:
            self._remove_peer(name)
        for peer in changes.changed_peers:  # before any comes who may have a key that one of them gives up
            self._change_peer(peer)
        for peer in changes.added_peers:
            self._add_peer(peer)
        for name in changes.closed_endpoints:
            self._close_endpoint(name)
        for endpoint, each in zip(opened, changes.opened_endpoints, strict=True):
            self.endpoints.append(endpoint)
            self._start_endpoint(endpoint, each)
        for each in changes.changed_endpoints:
            self._change_endpoint(each)
        self._warn()
        self.log.info("configuration_reloaded", **changes.summary())
        self._arm()

    def _on_hangup(self) -> None:
        if len(self._hangups) < 2:  # else one waits already, which reads the file later than now
            task = self._loop.create_task(self._reload_for_signal())
            self._hangups.add(task)
            task.add_done_callback(self._hangups.discard)

    async def _reload_for_signal(self) -> None:
        with suppress(ConfigError):  # logged already
            await self.reload()

    def _add_peer(self, config: PeerConfig) -> None:
        now, has_previous = monotonic(), self.config.previous_private_key is not None
        link = PeerLink(config, self.node, self._perform, now, self.recorder)
        link.join(now, self._graces, self.config.key_grace_s, has_previous_key=has_previous)
        self.links[config.name] = link
        self.switch.add(link, link.policy)
        self._note_who_waits()
        self.peer_sockets.follow(link, self._arm)

    def _remove_peer(self, name: str) -> None:
        """End the link at once: from now on nothing of this peer is accepted."""
        self.peer_sockets.stop_following(name)
        link = self.links[name]
        self.switch.remove(link)
        link.leave(monotonic())
        del self.links[name]
        self._note_who_waits()
        self._events.forget(name)

    def _change_peer(self, config: PeerConfig) -> None:
        """Other rules or addresses for the same identity: its session goes on."""
        link = self.links[config.name]
        self.peer_sockets.stop_following(config.name)
        link.change(config, monotonic())
        self.switch.set_policy(link, link.policy)
        self._note_who_waits()
        self.peer_sockets.follow(link, self._arm)

    def _note_who_waits(self) -> None:
        self._can_wait = any(link.egress is not None for link in self.links.values())
        gather_s = min((link.gather_s for link in self.links.values()), default=0.0)
        self._gather_s = gather_s if gather_s <= GATHER_AT_MOST_S else 0.0
        for endpoint in self.endpoints:
            endpoint.gather(self._gather_s)

    def _start_endpoint(self, endpoint: Endpoint, config: EndpointConfig) -> None:
        self._change_endpoint(config)
        endpoint.gather(self._gather_s)
        endpoint.start()

    def _close_endpoint(self, name: str) -> None:
        endpoint = next(each for each in self.endpoints if each.name == name)
        self.endpoints.remove(endpoint)
        for port in endpoint.ports:
            self.switch.remove(port)
        endpoint.close()
        del self.endpoint_policies[name]
        self._events.forget_endpoint(name)
        self._radio_status.pop(name, None)

    def _change_endpoint(self, config: EndpointConfig) -> None:
        policy = self.endpoint_policies[config.name] = config.make_policy()
        for endpoint in self.endpoints:
            if endpoint.name == config.name:
                for port in endpoint.ports:
                    self.switch.set_policy(port, policy)
        self._radio_status.pop(config.name, None)
        if config.radio_status:
            self._radio_status[config.name] = RadioStatusSource()

    # What the endpoints report.

    def on_port_opened(self, port: LocalPort) -> None:
        """A local program is there: frames may come from it and go to it."""
        self._events.program("program_found", port.endpoint.name, port.name, monotonic())
        self.switch.add(port, self.endpoint_policies[port.endpoint.name])

    def on_port_closed(self, port: LocalPort) -> None:
        """A local program is gone."""
        self._events.program("program_gone", port.endpoint.name, port.name, monotonic())
        self.switch.remove(port)

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """What a local program sent in one wake-up."""
        self._forward(port, frames, now, epoch, waited_s)
        self._settle()

    # What the peers send.

    def _on_peer_frames(self, name: str, frames: list[Frame], now: float, epoch: int) -> None:
        if self.recorder is not None:
            self.recorder.add(name, [frame.raw for frame in frames], FROM_PEER, now)
        self._forward(self.links[name], frames, now, epoch)

    def _forward(
        self, source: PeerLink | LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0
    ) -> None:
        if epoch != self.stall.turn(monotonic()):  # every frame passes here; a pause may have been since its read
            who = source.name if isinstance(source, PeerLink) else source.endpoint.name
            self.stall.dropped[who] += len(frames)
            self._drops.add("frames_dropped", "stale", who, len(frames), now)
        else:
            self.switch.forward(source, frames, now, waited_s)

    # Outputs of the core.

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, o.Transmit):
                self.peer_sockets.send(*output)
            elif isinstance(output, o.Deliver):
                name = link_name(output.peer)
                frames = split_payload(output.payload, self.links[name].counters)
                self._intake.add(name, frames, cost_of(output.payload, len(frames)))
            elif isinstance(output, o.Dropped):
                self._on_dropped(output)
            else:
                self._on_event(output)

    def _on_dropped(self, dropped: o.Dropped) -> None:
        reason, peer, path, amount, detail = dropped
        if path is None:
            self._drops.add("frames_dropped", reason, peer or "", amount, monotonic())
        else:
            last = f"{detail} from {Address(*path[1:])}".strip()
            self._drops.add("datagrams_dropped", reason, peer or "", amount, monotonic(), last)

    def _on_event(self, event: o.Event) -> None:
        now = monotonic()
        self._events.write(event, now)
        link = self.links[link_name(event.peer)]
        if isinstance(event, o.PeerLost | o.PeerClosed):
            if not link.peer.is_up:  # by no key
                link.on_down(now)
        elif isinstance(event, o.PathChanged | o.SessionEstablished):
            link.on_session()
            is_current = isinstance(event, o.SessionEstablished) and event.peer == link.name
            if is_current and link.confirm(now, self._graces):
                self.log.info("key_change_confirmed", peer=link.name)

    # Time.

    def _settle(self) -> None:
        """Something came: what it made due may be earlier than the timer."""
        if self._can_wait or self.node.next_deadline() < self._timer_at:
            self._arm()

    def _arm(self) -> None:
        """Have the one timer fire at the next deadline. A later one is cheap: it is moved only to be earlier."""
        deadline = min(self.node.next_deadline(), self._drops.next_flush, self._housekeeping_at)
        if self._can_wait:
            deadline = min(deadline, *(link.next_deadline() for link in self.links.values()))
        if deadline < self._timer_at:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at = deadline
            self._timer = self._loop.call_later(max(0.0, deadline - monotonic()) + LOOP_TICK_S, self._on_timer)

    def _on_timer(self) -> None:
        now, self._timer_at = monotonic(), NEVER
        self.stall.turn(now)
        try:
            self._perform(self.node.handle_timeout(now))
            for link in self.links.values():
                link.send_waiting(now)
            self._drops.flush(now)
            if now >= self._housekeeping_at:
                self._housekeeping_at = now + HOUSEKEEPING_S
                self._do_housekeeping(now)
        finally:
            self._arm()

    def _on_pause(self, pause_s: float) -> None:
        self.log.warning("daemon_stood_still", seconds=round(pause_s, 3))

    def _do_housekeeping(self, now: float) -> None:
        up = sum(link.peer.is_up for link in self.links.values())
        self.supervisor.turn(f"{up} of {len(self.links)} peers up", now)
        if self.recorder is not None:
            self.recorder.do_housekeeping(now)
        for link in self.links.values():
            if link.is_unheard(now):
                self._events.unheard(link.name, link.config.addresses)
            link.measure(now)
            self._events.disturbed(link.peer.name, link.disturbances(now), now)
            if link.end_graces(now, self._graces):
                self.log.warning("previous_key_expired", peer=link.name)
        radio = radio_figures(self.links.values())
        for endpoint in self.endpoints:
            endpoint.do_housekeeping(now)
            self._events.look_at(endpoint, now)
            source = self._radio_status.get(endpoint.name)
            if source is not None and radio is not None:
                frames = split_payload(source.frame(radio), SplitCounters())
                for port in endpoint.ports:
                    endpoint.write(port, frames, self._own, now)

    # The control socket.

    async def _answer(self, request: str) -> dict[str, object] | None:
        match request:
            case "status":
                return daemon_status(self, monotonic())
            case "reload":
                try:
                    await self.reload()
                except ConfigError as error:
                    return {"problems": str(error).splitlines()}
                return {"problems": []}
        return None
