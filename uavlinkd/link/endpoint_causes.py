"""What is wrong with a local endpoint: no client, a silent one, a device that cannot be opened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Protocol

from uavlinkd.config import EndpointConfig
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.endpoints.url import EndpointKind
from uavlinkd.link.down_causes import finding, listed
from uavlinkd.link.history import History
from uavlinkd.link.local_endpoints import LocalEndpoints
from uavlinkd.link.passage import Key
from uavlinkd.link.traffic_causes import REFUSED_S, SECURITY_S, all_refused, commands, hidden_frames
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Subject
from uavlinkd.system.error_meanings import meaning_of

SILENT_S: Final = 5.0
"""An endpoint without frames for this time is reported: MAVLink clients send a heartbeat every second."""
FAILED_S: Final = 5.0
"""The errors of opening an endpoint count for this time. It is tried again more often."""

_REFUSED: Final = ("ECONNREFUSED", "connect_timeout", "EHOSTUNREACH", "ENETUNREACH")
_NOT_RESOLVED: Final = "not_resolved"


class Local(Protocol):
    """The parts of a daemon that know about its endpoints."""

    local: LocalEndpoints
    history: History


def endpoint_findings(
    daemon: Local, endpoint: Endpoint, config: EndpointConfig, blocked: Sequence[Key], now: float
) -> Iterator[Finding]:
    """Everything about one endpoint."""
    name, history = endpoint.name, daemon.history.endpoint(endpoint.name)
    if count := history.incoming.reasons.within(SECURITY_S, now).get(Refusal.HIDDEN_FRAME):
        yield hidden_frames(Subject.ENDPOINT, name, count)
    for direction, gate in (("in", history.incoming), ("out", history.outgoing)):
        reasons = gate.reasons.within(REFUSED_S, now)
        if reasons and ("endpoint", name, direction) in blocked:
            yield all_refused(Subject.ENDPOINT, name, direction, reasons, config.policy)
    yield from commands(Subject.ENDPOINT, name, history.incoming, history.outgoing, config.policy, now)
    if now - history.silent_since >= SILENT_S:
        failed = history.failures.within(FAILED_S, now)
        has_garbage = bool(history.garbage.within(FAILED_S, now))
        yield _silent(endpoint, config, failed, has_garbage=has_garbage, silent_s=now - history.silent_since)


def _silent(
    endpoint: Endpoint, config: EndpointConfig, failed: Mapping[str, int], *, has_garbage: bool, silent_s: float
) -> Finding:
    name, url, kind = endpoint.name, config.url, config.url.kind
    if has_garbage:
        text = f"bytes arrive at {url}, and none of them is MAVLink"
        remedy = "correct the baud rate, set the port of the autopilot to MAVLink, and let only this daemon read it"
        return _about(Cause.GARBAGE, name, text, remedy)
    if endpoint.ports and (kind is not EndpointKind.UDPOUT or not failed.keys() & {*_REFUSED}):
        clients = listed(port.name for port in endpoint.ports)
        text = f"the client {clients} has sent no MAVLink for {silent_s:.0f} s"
        remedy = (
            "check that it runs, speaks MAVLink here and sends, not only listens; then power, wiring and baud rate"
        )
        return _about(Cause.CLIENT_SILENT, name, text, remedy)
    if kind is EndpointKind.SERIAL:
        error = next(iter(failed), "")
        text = f"{url} cannot be opened{f' ({error})' if error else ''}"
        return _about(Cause.DEVICE_UNAVAILABLE, name, text, meaning_of(error) or "plug the device in")
    if url.listens:
        text = f"no client has sent MAVLink to {url} within {silent_s:.0f} s"
        return _about(Cause.NO_CLIENT, name, text, "let the autopilot or ground station send there")
    if _NOT_RESOLVED in failed or (kind is EndpointKind.UDPOUT and not endpoint.ports):
        text, remedy = f"the host of {url} has no address now", "write an IP address, or see `getent hosts NAME`"
        return _about(Cause.CLIENT_UNREACHABLE, name, text, remedy)
    error = next((error for error in _REFUSED if error in failed), "")
    text = f"no process listens at {url}{f' ({error})' if error else ''}"
    return _about(Cause.CLIENT_UNREACHABLE, name, text, "start the client there, or correct the port")


def _about(cause: Cause, name: str, text: str, remedy: str) -> Finding:
    return finding(cause, Subject.ENDPOINT, name, text, remedy)
