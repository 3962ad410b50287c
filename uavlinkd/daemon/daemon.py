"""The life of a daemon: its start and stop, reloads of the configuration, and what is done once a second."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_in_thread
from uavlinkd.config.model import Config, ConfigError
from uavlinkd.daemon.carrier import FrameCarrier
from uavlinkd.daemon.features import Feature
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.mavlink.own_frames import INTERVAL_S
from uavlinkd.observe.observer import Observer
from uavlinkd.observe.status import daemon_status, overview
from uavlinkd.ops import LOG_SCHEMA, NETCHECK_SCHEMA
from uavlinkd.ops.control import ControlServer
from uavlinkd.ops.sdnotify import Supervisor
from uavlinkd.system.base64_text import to_base64
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report, run
from uavlinkd.system.tasks import on_signal
from uavlinkd.system.terminal import printable

if TYPE_CHECKING:
    from collections.abc import Hashable


HOUSEKEEPING_S = INTERVAL_S
"""How often links are measured, and idle clients forgotten."""
LOOKS_EVERY = 4
"""Intervals from one look for findings to the next: a look costs as much as all else that is done in one."""


class Daemon:
    """One uavlinkd: the peers on one side, the local MAVLink endpoints on the other.

    Call :meth:`run`, or :meth:`start` and later :meth:`stop`.
    """

    def __init__(self, config: Config) -> None:
        self.log = structlog.get_logger().bind(daemon=config.name)
        self._loop = asyncio.get_running_loop()
        self.parts = DaemonParts(config, self.log, monotonic())
        self.observer = Observer(self.parts, self.log, monotonic())
        self.carrier = FrameCarrier(self.parts)
        self._housekeeping: asyncio.TimerHandle | None = None
        self._reporting: asyncio.Handle | None = None
        self._seconds = 0
        self._control: ControlServer | None = None
        self._supervisor = Supervisor(os.environ, os.getpid())
        self._reload_lock = asyncio.Lock()
        self._hangups: set[asyncio.Task[None]] = set()
        self._work: dict[Hashable, float] = {}
        self._is_stuck = False

    # Life.

    async def run(self) -> None:
        """Start, work until SIGTERM or SIGINT, and end cleanly. Raises as :meth:`start`, having started nothing."""
        stop = asyncio.Event()
        for name in ("SIGTERM", "SIGINT"):
            on_signal(name, stop.set)
        self._loop.set_exception_handler(self.parts.guard.on_failure)
        on_signal("SIGHUP", self.on_hangup)
        await self.start()
        try:
            await stop.wait()
        finally:
            await self.stop()

    async def start(self) -> None:
        """Bind every socket, then start to read. Raises BindError or ControlError if one of them cannot be opened."""
        parts, config = self.parts, self.parts.config
        try:
            networks = [network for network in config.networks if network.serial is None]
            parts.peer_sockets.open(config.listen, networks, parts.path_kinds)
            parts.local.open(config.endpoints)
            if config.control_socket is not None:
                self._control = ControlServer(config.control_socket, self.answer)
                await self._control.start()
        except Exception:
            self._close_sockets()
            raise
        self.carrier.peers.start()
        parts.peer_sockets.start(parts.line.receive, self.carrier.arm, self.carrier.send_waiting)
        parts.local.start()
        self._write_warnings()
        self.log.info(
            "daemon_started",
            log_schema=LOG_SCHEMA,
            listen=[str(address) for address in parts.peer_sockets.addresses],
            endpoints={endpoint.name: str(endpoint.url) for endpoint in config.endpoints},
            peers=list(parts.links),
            **({} if parts.relay is None else {"members": len(parts.relay.members)}),
        )
        self.carrier.arm()
        self._housekeeping = self._loop.call_later(HOUSEKEEPING_S, self._do_housekeeping)
        self._supervisor.ready()

    async def stop(self) -> None:
        """Close the sessions with the peers, and all sockets."""
        parts = self.parts
        self._supervisor.stopping()
        if self._housekeeping is not None:
            self._housekeeping.cancel()
        if self._reporting is not None:
            self._reporting.cancel()
        self.carrier.stop()
        self._close_sockets()
        if self._control is not None:
            await self._control.stop()
        if parts.fleet is not None:
            await parts.fleet.stop()
        now = monotonic()
        problems = Counter[str]()
        for link in parts.links.values():
            problems.update({problem.value: count for problem, count in link.problems(now).items()})
        counted = {**self.observer.close(), **+problems}
        self.log.info("daemon_stopped", uptime_s=round(now - parts.started_at, 1), counted=counted)

    def _close_sockets(self) -> None:
        self.parts.peer_sockets.close()
        self.parts.local.close()

    def _write_warnings(self) -> None:
        for warning in self.parts.config.warnings:
            self.log.warning("configuration_warning", warning=warning)

    # Requests.

    async def answer(self, request: str) -> dict[str, object] | None:
        """The answer to a request on the control socket; None if there is no such request."""
        parts = self.parts
        match request.partition(" "):
            case ("status", "", ""):
                return daemon_status(self.observer, monotonic()) | {"is_stuck": self._is_stuck}
            case ("overview", _, names):
                return overview(self.observer, monotonic(), names.split())
            case ("problems", "", ""):
                return {"problems": self.observer.events.problems(monotonic())}
            case ("reload", "", ""):
                try:
                    await self.reload()
                except ConfigError as error:
                    return {"problems": str(error).splitlines()}
                return {"problems": [], "name": parts.config.name}
            case ("netcheck", "", ""):
                status = daemon_status(self.observer, monotonic())
                facts = {key: status[key] for key in ("name", "public_key", "relays")}
                web = {} if parts.tls is None else await parts.tls.probe()
                return {"schema": NETCHECK_SCHEMA, **facts, "web": web}
            case ("signing", " ", wish):
                return await parts.signing.answer(wish)
            case ("bulletin", "", "") if parts.fleet is not None:
                return {"bulletin": to_base64(parts.fleet.trust.bulletin_bytes)}
            case ("fleet", "", "") if parts.fleet is not None:
                return parts.fleet.trust.known()
            case ("publish", " ", signed) if parts.fleet is not None:
                return parts.fleet.publish(signed, monotonic())
        return None

    async def reload(self) -> None:
        """Reload when the reloads before have ended. Raises ConfigError if the new file was refused, as a whole."""
        async with self._reload_lock:
            self._supervisor.reloading()
            try:
                await self._apply_file()
            except BaseException:
                self._supervisor.ready("the new configuration was refused")
                raise
            self._supervisor.ready()

    def on_hangup(self) -> None:
        """SIGHUP came: reload, unless a reload waits already, which will read the file later."""
        if len(self._hangups) < 2:
            task = self._loop.create_task(self._reload_for_signal())
            self._hangups.add(task)
            task.add_done_callback(self._hangups.discard)

    async def _reload_for_signal(self) -> None:
        with suppress(ConfigError):  # logged already
            await self.reload()

    async def _apply_file(self) -> None:
        """Read the configuration again and apply its changes. Everything else stays as it is.

        Raises ConfigError: the new file is wrong, or changes what only a restart can change. The old configuration
        stays in force, as a whole.
        """
        before = self.parts.config
        try:
            config = await load_in_thread(before.path, os.environ)
            changes = compare(before, config)
        except ConfigError as error:
            self.parts.journal.refused_file = problems = [printable(line) for line in str(error).split("\n")]
            self.log.error("configuration_refused", problems=problems)
            raise
        self.parts.journal.refused_file = []
        try:
            self.carrier.peers.follow(config, changes)
            for endpoint in changes.changed_endpoints:
                self.parts.local.set_policy(endpoint.name, endpoint.make_policy())
        except Exception as error:  # neither configuration is in force: start again with the file
            report(error, most=1)
            raise
        self._write_warnings()
        self.log.info("configuration_reloaded", **changes.summary)
        self.carrier.arm()

    # Once a second.

    def _do_housekeeping(self) -> None:
        now, parts = monotonic(), self.parts
        self._housekeeping = self._loop.call_later(HOUSEKEEPING_S, self._do_housekeeping)
        parts.stall.turn(now)
        self._feed_watchdog(now)
        run(parts.peer_sockets.do_housekeeping)
        for feature in parts.features:
            run(self._do_housekeeping_of, feature, now)
        links = list(parts.links.values())
        for link in links:
            run(link.measure, now)
            run(link.report_refusals, now)
        self.observer.sample(now)
        run(parts.local.do_housekeeping, links, now)
        self._seconds += 1
        if self._seconds % LOOKS_EVERY == 0:
            self._reporting = self._loop.call_soon(self._report, now)  # datagrams must not wait for all of it

    def _feed_watchdog(self, now: float) -> None:
        """Feed it unless work that waited a second ago still waits, and nothing of its kind was done meanwhile."""
        before, self._work = self._work, self.parts.stall.unread() | self.carrier.waiting(now)
        stuck = [kind for kind, at in self._work.items() if before.get(kind) == at]
        if stuck and not self._is_stuck:
            self.log.error("work_stuck", count=len(stuck), kinds=list(map(str, stuck)))
        self._is_stuck = bool(stuck)
        self._supervisor.turn(self.carrier.peers.summary(), now, work_moves=not stuck)

    def _do_housekeeping_of(self, feature: Feature, now: float) -> None:
        feature.do_housekeeping(now)
        for reason, name, count in feature.count_drops():
            self.parts.journal.add("datagrams_dropped", reason, name, count, now)

    def _report(self, now: float) -> None:
        """Report what is wrong. A fault here ends no process that carries frames."""
        codes = self.observer.report(now)
        for link in self.parts.links.values():
            run(link.report_problems, codes, now)
        self.carrier.arm()
