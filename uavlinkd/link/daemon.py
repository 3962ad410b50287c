"""The shell: sockets, one timer, signals. It turns wake-ups into calls of the core, and outputs into sends and logs.

Between reading and sending a frame there is no task, queue, lock or ``await``. Frames wait only for a slow radio's
budget or a slow client.
"""

from __future__ import annotations

import asyncio
import os
from functools import partial
from typing import TYPE_CHECKING

import structlog

from uavlinkd.config import Config, ConfigError, PeerConfig
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_in_thread
from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.core.path import Path
from uavlinkd.core.timers import Schedule
from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.control_answers import answer
from uavlinkd.link.diagnosis import find
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.evidence import Evidence
from uavlinkd.link.forwarder import Forwarder
from uavlinkd.link.from_relays import FromRelays
from uavlinkd.link.history import History
from uavlinkd.link.intake import Intake
from uavlinkd.link.local_endpoints import LocalEndpoints
from uavlinkd.link.network_budgets import NetworkBudget, budgets_of, follow_rates
from uavlinkd.link.passage import Passage
from uavlinkd.link.peer_link import PeerLink, radio_figures
from uavlinkd.link.peer_owners import PeerOwner
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.pilot_notes import PilotNotes
from uavlinkd.link.relays import Relays
from uavlinkd.link.reloads import Reloads
from uavlinkd.link.roster import Roster
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.link.status import daemon_status
from uavlinkd.link.switch import Switch
from uavlinkd.mavlink.radio_status import INTERVAL_S
from uavlinkd.mavlink.routing import Router
from uavlinkd.mavlink.screening import screen
from uavlinkd.ops.control import ControlServer
from uavlinkd.ops.recorder import Recorder
from uavlinkd.ops.schema_versions import LOG_SCHEMA
from uavlinkd.ops.sdnotify import Supervisor
from uavlinkd.relay.service import RelayService
from uavlinkd.system.clock import monotonic
from uavlinkd.system.signals import on_signal
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.terminal import printable

if TYPE_CHECKING:
    from uavlinkd.ops.metrics_server import MetricsServer

LOOP_TICK_S = 0.001
"""A loop may fire a timer up to one tick of its clock early. The timer is set later by this."""
HOUSEKEEPING_S = INTERVAL_S
"""How often links are measured, and idle clients forgotten."""


class Daemon:
    """One uavlinkd: the peers on one side, the local MAVLink endpoints on the other.

    Call :meth:`run`, or :meth:`start` and later :meth:`stop`.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.log = structlog.get_logger().bind(daemon=config.name)
        now = monotonic()
        self.node = Node(config.private_key, os.urandom, now, config.previous_private_key, screen=screen)
        self.links: dict[str, PeerLink] = {}
        self._link_of: dict[LinkedPeer, PeerLink] = {}
        self.owners: dict[LinkedPeer, PeerOwner] = {}
        """Of the peers in the core that carry no frames."""
        self.evidence = Evidence(self.links, config.public_key)
        self.history = History(now)
        self.passage = Passage()
        routing = config.routing
        router = Router[PeerLink | LocalPort](relays=routing.relay, floods_unknown=routing.unknown_targets == "flood")
        self._loop = asyncio.get_running_loop()
        self._started_at = now
        limits = LineLimits()
        self._drops = DropSummary(self.log, limits)
        self.switch = Switch(router, self._drops.add_refused)
        self._notes = PilotNotes(router.addresses)
        self._events = EventLog(self.log, limits)
        self.stall = StallWatch(now, self._on_pause)
        forwarder = Forwarder(self.switch, self.stall, self._drops, self._settle)
        self._intake = Intake(
            self.node,
            self.stall,
            self.switch,
            self._link_of,
            self._perform,
            forwarder.on_peer_frames,
            self._settle,
            self._on_superseded,
            self._drop_datagram,
        )
        self.peer_sockets = PeerSockets(
            self._intake.receive, self.stall, self._drops, self.evidence, self.log, self.node
        )
        self._events.network_of = self.peer_sockets.network_name
        self.relays = Relays(self.node, self.peer_sockets, self.links, self.owners, self.log, self._arm)
        self.evidence.relays = self.relays.by_name
        self.local = LocalEndpoints(config.name, self.switch, self._events, self.stall, forwarder.on_frames)
        self.relay: RelayService | None = None
        if config.relay_server is not None:
            self.relay = RelayService(
                self.node,
                os.urandom,
                monotonic,
                config.relay_server.limits,
                perform=self._perform,
                send=self.peer_sockets.send,
                send_from_new_port=self.peer_sockets.send_from_new_port,
                on_event=self._events.write,
            )
            self.peer_sockets.pause_s = 0.0
        self._from_relays = FromRelays(self.relays, self.relay, self.owners, self._drop_datagram)
        self._roster = Roster(
            config=config,
            node=self.node,
            links=self.links,
            link_of=self._link_of,
            owners=self.owners,
            relays=self.relays,
            relay=self.relay,
            peer_sockets=self.peer_sockets,
            switch=self.switch,
            local=self.local,
            history=self.history,
            events=self._events,
            drops=self._drops,
            new_link=self._new_link,
            perform=self._perform,
            on_due=self._arm,
        )
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER
        self._housekeeping_at = now + HOUSEKEEPING_S
        self._waiting = Schedule[PeerLink]()
        self._budgets: dict[int, NetworkBudget] = {}
        """Of networks, by the number of the socket."""
        self._control: ControlServer | None = None
        self._metrics: MetricsServer | None = None
        self.recorder: Recorder | None = None
        self.supervisor = Supervisor(os.environ, os.getpid())
        self.reloads = Reloads(self._reload, self.supervisor)

    # Life.

    async def run(self) -> None:
        """Start, work until SIGTERM or SIGINT, and end cleanly.

        Raises:
            BindError: if the daemon cannot listen on an address. Then nothing was started.
            ControlError: if it cannot open the control socket. Then nothing was started.
        """
        stop = asyncio.Event()
        for name in ("SIGTERM", "SIGINT"):
            on_signal(name, stop.set)
        self._loop.set_exception_handler(self._drops.on_loop_failure)
        on_signal("SIGHUP", self.reloads.on_hangup)
        await self.start()
        try:
            await stop.wait()
        finally:
            await self.stop()

    async def start(self) -> None:
        """Bind every socket, then start to read.

        Raises:
            BindError: if the daemon cannot listen on an address.
            ControlError: if it cannot open the control socket.
        """
        try:
            self.peer_sockets.open(self.config.listen, self.config.networks)
            self._budgets.update(budgets_of(self.peer_sockets.networks, self.peer_sockets.serial, monotonic()))
            self.node.set_budgets({number: budget.bits_s for number, budget in self._budgets.items()})
            serial = self.peer_sockets.serial
            self.node.set_envelope_limits({line.number: line.envelope_limit for line in serial.networks})
            self.local.open(self.config.endpoints)
            if self.config.metrics is not None:
                from uavlinkd.ops.metrics_server import serve_metrics  # noqa: PLC0415  only if configured

                self._metrics = await serve_metrics(self.config.metrics, lambda: daemon_status(self, monotonic()))
            if self.config.control_socket is not None:
                self._control = ControlServer(self.config.control_socket, partial(answer, self))
                await self._control.start()
        except Exception:
            self._close_sockets()
            raise
        if self.config.recording is not None:
            self.recorder = Recorder(self.config.recording, self.log)
        self._roster.start()
        self._intake.takers = self._from_relays.takers
        self.peer_sockets.start(self._arm)
        self.local.start(self.config.endpoints)
        self._warn()
        self.log.info(
            "daemon_started",
            log_schema=LOG_SCHEMA,
            listen=[str(address) for address in self.peer_sockets.addresses],
            endpoints={endpoint.name: str(endpoint.url) for endpoint in self.config.endpoints},
            peers=list(self.links),
            **({} if self.relay is None else {"members": len(self.relay.members)}),
        )
        self._arm()
        self.supervisor.ready()

    async def stop(self) -> None:
        """Close the sessions with the peers, and all sockets."""
        self.supervisor.stopping()
        if self._timer is not None:
            self._timer.cancel()
        self._intake.clear()
        self._perform(self.node.close(monotonic()))
        self._close_sockets()
        if self._control is not None:
            await self._control.stop()
        now = monotonic()
        for link in self.links.values():
            self._events.check_link(link, now)
        self._drops.close()
        self._events.close()
        if self.recorder is not None:
            self.recorder.stop(now)
        counted = {**self._drops.plain_totals(), **self._events.totals, **self.peer_sockets.serial.totals}
        self.log.info("daemon_stopped", uptime_s=round(now - self._started_at, 1), counted=counted)

    def _close_sockets(self) -> None:
        self.peer_sockets.close()
        self.local.close()
        if self._metrics is not None:
            self._metrics.stop()

    def _warn(self) -> None:
        for warning in self.config.warnings:
            self.log.warning("configuration_warning", warning=warning)

    # Reload.

    async def _reload(self) -> None:
        """Read the configuration again and apply its changes. Everything else stays as it is.

        Raises:
            ConfigError: the new file is wrong, changes what only a restart can change, or has an endpoint that cannot
                be opened. The old configuration stays in force, as a whole.
        """
        try:
            config = await load_in_thread(self.config.path, os.environ)
            changes = compare(self.config, config)
            opened = self.local.open_new(config, self.config, changes)
        except ConfigError as error:
            self.log.error("configuration_refused", problems=[printable(line) for line in str(error).split("\n")])
            raise
        self.config = config
        self._roster.follow(config, changes)
        self._intake.takers = self._from_relays.takers
        for name in changes.closed_endpoints:
            self.local.close_one(name)
        for endpoint, endpoint_config in zip(opened, changes.opened_endpoints, strict=True):
            self.local.add(endpoint, endpoint_config)
        for endpoint_config in changes.changed_endpoints:
            self.local.change(endpoint_config)
        self._warn()
        self.log.info("configuration_reloaded", **changes.summary())
        self._arm()

    def _new_link(self, config: PeerConfig, now: float) -> PeerLink:
        return PeerLink(config, self.node, self._perform, now, self.recorder, self._waiting, self._budgets)

    # Drops.

    def _on_superseded(self, link: PeerLink, count: int) -> None:
        self._drops.add("frames_dropped", ShellReason.SUPERSEDED, link.name, count, monotonic())

    def _drop_datagram(self, reason: DropReason, name: str = "", path: Path | None = None) -> None:
        """Count a datagram that the core does not drop."""
        self.node.drops[reason] += 1
        self._drops.add("datagrams_dropped", reason, name, 1, monotonic(), "" if path is None else ("", path))

    # Outputs of the core.

    def perform(self, outputs: list[Output]) -> None:
        """Execute outputs that a request caused."""
        self._perform(outputs)
        self._settle()

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, o.Transmit):
                if self._budgets and (budget := self._budgets.get(output.path.socket)) is not None:
                    budget.charge(output.datagram, output.path, monotonic())
                self.peer_sockets.send(output.datagram, output.path)
            elif isinstance(output, o.Deliver):
                self._intake.add(output)
            elif isinstance(output, o.Dropped):
                now = monotonic()
                self._drops.add_dropped(output, now)
                self.evidence.add_dropped(output, now)
            elif isinstance(output, o.RecordReceived):
                self._from_relays.on_record(output, monotonic())
            else:
                self._on_event(output)

    def _on_event(self, event: o.Event) -> None:
        now = monotonic()
        if (owner := self.owners.get(event.peer)) is not None:
            owner.on_event(event, now)
        link = self._link_of.get(event.peer)
        if link is None:
            return
        self.relays.on_peer_event(event, now)
        if isinstance(event, o.PathSuspected):
            return
        self._events.write(event, now)
        if isinstance(event, o.PeerLost | o.PeerClosed):
            if not link.peer.is_up:  # with any key
                link.on_down(now)
        elif isinstance(event, o.PathChanged | o.PathStateChanged | o.SessionEstablished):
            link.follow_paths(now)
            path = link.peer.path
            if isinstance(event, o.SessionEstablished) and path is not None and not path.is_relayed:
                self.history.add_session(link.name, path.address, now)
            is_current = isinstance(event, o.SessionEstablished) and event.peer is link.peers[0]
            if is_current and self._roster.confirm_keys(link, now):
                self.log.info("key_change_confirmed", peer=link.name)

    # Time.

    def _settle(self) -> None:
        """After new input: a deadline may now be earlier than the timer."""
        if self.relay is not None and self.relay.is_due:
            self.relay.settle(monotonic())
        if self.node.next_deadline() < self._timer_at or self._waiting.next_at < self._timer_at:
            self._arm()

    def _arm(self) -> None:
        """Set the one timer to the next deadline. It is moved only to an earlier time: firing too early is cheap."""
        deadline = min(self.node.next_deadline(), self._waiting.next_at, self._housekeeping_at, self.relays.next_at)
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
            for link in self._waiting.pop(now):
                link.send_waiting(now)
            if now >= self.relays.next_at:
                self._perform(self.relays.handle_timeout(now))
            if now >= self._housekeeping_at:
                self._housekeeping_at = now + HOUSEKEEPING_S
                self._do_housekeeping(now)
        finally:
            self._arm()

    def _on_pause(self, pause_s: float) -> None:
        self.history.paused = monotonic(), pause_s
        self._events.write_pause(pause_s, monotonic())

    def _do_housekeeping(self, now: float) -> None:
        self.supervisor.turn(self._roster.summary(), now)
        if self.relay is not None:
            self.relay.do_housekeeping(now)
            for reason, name, count in self.relay.count_drops():
                self._drops.add("datagrams_dropped", reason, name, count, now)
        if self.recorder is not None:
            self.recorder.do_housekeeping(now)
        self.peer_sockets.do_housekeeping()
        if rates := follow_rates(self.peer_sockets.serial, self._budgets, self.links.values(), now):
            self.node.set_rates(rates, now)
        self.relays.do_housekeeping(now)
        for link in self.links.values():
            link.note_silence(now)
            link.measure(now)
            link.report_refusals(now)
            self._events.check_link(link, now)
            if self._roster.end_graces(link, now):
                self.log.warning("previous_key_expired", peer=link.name)
        self.passage.add_sample(self.links.values(), self.local.judged)
        self.history.sample(self.links.values(), self.local.judged, now)
        self.local.do_housekeeping(radio_figures(self.links.values()), now)
        self.local.write_note(self._notes.next(self.links.values(), now), now)
        self._events.write_findings(find(self, now), now)
        self._drops.check(now)
        self._events.check(now)
