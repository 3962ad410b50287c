"""Losses of a real daemon that a busy machine causes: the daemon did not run, and counts what that cost."""

from __future__ import annotations

from tests.kernel_queues import receive_queue
from tests.processes.process import DaemonProcess, Status

REASONS = ("delayed", "doubtful", "late", "no_session", "session_expired", "unknown_index")
"""Drops after a daemon, or its peer, had not run for seconds: what waited is too old, or its session has ended."""


async def lost_to_waiting(daemon: DaemonProcess, peer: DaemonProcess) -> int:
    """Frames between two daemons that the first one lost because a process had to wait for a processor.

    The kernel dropped them at a full socket, or the daemon dropped them as too old. A frame that the daemon drops for
    its own reasons, such as ``over_share``, is not counted.
    """
    status = await daemon.status()
    return kernel_drops(daemon) + _too_old(status, peer.name)


def kernel_drops(daemon: DaemonProcess) -> int:
    urls = [str(endpoint["url"]) for endpoint in daemon.config["endpoint"]]
    ports = [daemon.sockaddr[1], *(int(url.rpartition(":")[2]) for url in urls if url.startswith("udpin"))]
    return sum(receive_queue(port).dropped for port in ports)


def _too_old(status: Status, peer: str) -> int:
    drops = status["peers"][peer]["drops"]
    names = (peer, *status["endpoints"])
    stale = sum(status["stale"].get(name, 0) for name in names)
    return int(stale + sum(drops.get(reason, 0) + status["drops"].get(reason, 0) for reason in REASONS))
