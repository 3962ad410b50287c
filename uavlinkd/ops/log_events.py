"""The closed list of log events, with their levels and fields. README.md explains them.

The tests compare every line of a real daemon with this list.

A renamed or removed event or field breaks the scripts that read logs: it needs a line in CHANGELOG.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

COMMON_FIELDS: Final = ("event", "level", "daemon", "timestamp")
"""Fields of each line, ``event`` first."""
LOSS_FIELDS: Final = ("omitted_before", "lines_lost_before")
"""Fields that any line may have: lines that a limit omitted, and lines that could not be written."""


class LogEvent(NamedTuple):
    """One event of the daemon."""

    levels: tuple[str, ...]
    fields: tuple[str, ...] = ()
    """Each line has these."""
    optional: tuple[str, ...] = ()
    """A line may have these."""


_CHANGES = (
    *("peers_removed", "peers_added", "peers_changed"),
    *("endpoints_closed", "endpoints_opened", "endpoints_changed"),
    *("members_removed", "members_added", "members_changed"),
    *("relays_removed", "relays_added", "relays_changed"),
)
_INFO, _WARNING = ("info",), ("warning",)
_FINDING = ("cause", "severity", "subject", "name")
_DROP = ("reason", "count")
_DROP_OPTIONAL = ("who", "meaning", "last")

LOG_EVENTS: Final[Mapping[str, LogEvent]] = {
    # The daemon.
    "daemon_started": LogEvent(_INFO, ("log_schema", "listen", "endpoints", "peers"), ("members",)),
    "daemon_stopped": LogEvent(_INFO, ("uptime_s", "counted")),
    "daemon_paused": LogEvent(_WARNING, ("count", "seconds")),
    "pauses_ended": LogEvent(_INFO, ("count", "seconds", "duration_s")),
    "configuration_warning": LogEvent(_WARNING, ("warning",)),
    "configuration_reloaded": LogEvent(_INFO, (), _CHANGES),
    "configuration_refused": LogEvent(("error",), ("problems",)),
    # A link.
    "session_established": LogEvent(
        ("info", "debug"), ("peer", "generation", "suite", "mode", "tag_bits", "initiated_by", "rekey")
    ),
    "peer_up": LogEvent(_INFO, ("peer",)),
    "peer_lost": LogEvent(_WARNING, ("peer", "silent_s")),
    "peer_closed": LogEvent(_INFO, ("peer",)),
    "peer_unreachable": LogEvent(_WARNING, ("peer", "reason")),
    "path_changed": LogEvent(_INFO, ("peer", "path", "before", "reason"), ("network", "network_before")),
    "path_usable": LogEvent(_INFO, ("peer", "path", "reason"), ("network",)),
    "path_down": LogEvent(_WARNING, ("peer", "path", "reason"), ("network",)),
    "relay_up": LogEvent(_INFO, ("relay",)),
    "relay_lost": LogEvent(_WARNING, ("relay", "silent_s")),
    "relay_closed": LogEvent(_INFO, ("relay",)),
    "repair_began": LogEvent(_INFO, ("peer", "transmissions")),
    "repair_ended": LogEvent(_INFO, ("peer", "duration_s", "bytes")),
    "key_change_confirmed": LogEvent(_INFO, ("peer",)),
    "previous_key_expired": LogEvent(_WARNING, ("peer",)),
    "link_problem_began": LogEvent(_WARNING, ("peer", "problem", "count", "meaning"), ("share",)),
    "link_problem_continued": LogEvent(_WARNING, ("peer", "problem", "count", "duration_s"), ("share",)),
    "link_problem_ended": LogEvent(_INFO, ("peer", "problem", "count", "duration_s")),
    # Drops.
    "datagrams_dropped": LogEvent(_WARNING, _DROP, _DROP_OPTIONAL),
    "frames_dropped": LogEvent(_WARNING, _DROP, _DROP_OPTIONAL),
    "frames_refused": LogEvent(_WARNING, _DROP, _DROP_OPTIONAL),
    "frames_withheld": LogEvent(("info", "warning"), ("reason",), ("count", *_DROP_OPTIONAL)),
    "sends_failed": LogEvent(_WARNING, _DROP, _DROP_OPTIONAL),
    "connections_failed": LogEvent(_WARNING, _DROP, _DROP_OPTIONAL),
    "drops_continued": LogEvent(_WARNING, ("kind", *_DROP, "duration_s"), ("who", "last")),
    "drops_ended": LogEvent(_INFO, ("kind", *_DROP, "duration_s"), ("who", "last")),
    # Findings, as in `status`.
    "problem_began": LogEvent(("error", "warning", "info"), (*_FINDING, "text", "remedy")),
    "problem_continued": LogEvent(("error", "warning"), (*_FINDING, "text", "remedy", "duration_s")),
    "problem_ended": LogEvent(_INFO, (*_FINDING, "duration_s")),
    # Endpoints.
    "client_connected": LogEvent(_INFO, ("endpoint", "client")),
    "client_disconnected": LogEvent(_INFO, ("endpoint", "client")),
    "endpoint_not_open": LogEvent(_WARNING, ("endpoint", "reason", "meaning")),
    # The machine.
    "network_appeared": LogEvent(_INFO, ("network", "addresses", "interface_index")),
    "network_changed": LogEvent(_INFO, ("network", "addresses", "interface_index")),
    "network_disappeared": LogEvent(_WARNING, ("network", "reason")),
    "network_not_here_yet": LogEvent(_WARNING, ("network", "reason")),
    "name_not_resolved": LogEvent(_WARNING, ("host", "meaning")),
    "address_not_here_yet": LogEvent(_WARNING, ("address", "meaning")),
    "recording_stopped": LogEvent(_WARNING, ("reason", "error", "folder", "retried_every_s", "meaning")),
    "recording_resumed": LogEvent(_INFO, ("frames_lost",)),
}
"""By name: a noun and a verb in the past."""
