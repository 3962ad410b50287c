"""Answers on the control socket."""

from __future__ import annotations

from typing import Protocol

from uavlinkd.config import ConfigError
from uavlinkd.core.outputs import Output
from uavlinkd.link.reachability import ping, views
from uavlinkd.link.reloads import Reloads
from uavlinkd.link.status import DaemonParts, daemon_status
from uavlinkd.system.clock import monotonic


class Controlled(DaemonParts, Protocol):
    """The parts of a daemon that requests read, and what they can have it do."""

    reloads: Reloads

    def perform(self, outputs: list[Output]) -> None:
        """Execute outputs of the core."""


async def answer(daemon: Controlled, request: str) -> dict[str, object] | None:
    """The answer to a request; None if there is no such request."""
    match request.partition(" "):
        case ("status", "", ""):
            return daemon_status(daemon, monotonic())
        case ("reload", "", ""):
            try:
                await daemon.reloads.run()
            except ConfigError as error:
                return {"problems": str(error).splitlines()}
            return {"problems": [], "name": daemon.config.name}
        case ("netcheck", "", ""):
            tests = daemon.relays.filter_tests
            tests.begin(daemon.relays.by_name.values(), monotonic())
            await tests.ended.wait()
            return views(daemon.relays, daemon.peer_sockets, is_relay=daemon.relay is not None)
        case ("ping", " ", name):
            network_of = daemon.peer_sockets.network_name
            paths, outputs = ping(daemon.links, daemon.relays, name, daemon.node, network_of, monotonic())
            daemon.perform(outputs)
            return paths
    return None
