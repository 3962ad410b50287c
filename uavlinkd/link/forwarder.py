"""Passes frames of clients and peers to the switch, but for those from before a pause of this process."""

from __future__ import annotations

from collections.abc import Callable

from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.link.switch import Switch
from uavlinkd.mavlink.frames import Frame
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALL_S, StallWatch


class Forwarder:
    """Forwards fresh frames. ``settle`` is called when the core may have new deadlines."""

    def __init__(self, switch: Switch, stall: StallWatch, drops: DropSummary, settle: Callable[[], None]) -> None:
        self._switch = switch
        self._stall = stall
        self._drops = drops
        self._settle = settle

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Forward the frames that a local client sent in one wake-up."""
        stall = self._stall
        if epoch == stall.epoch and monotonic() - stall.turned_at <= STALL_S:
            self._switch.forward(port, frames, now, waited_s)
        else:
            self._forward_if_fresh(port, frames, now, epoch, waited_s)
        self._settle()

    def on_peer_frames(self, link: PeerLink, frames: list[Frame], now: float, epoch: int) -> None:
        """Forward the frames that a peer sent in one turn."""
        link.record_received(frames, now)
        self._forward_if_fresh(link, frames, now, epoch)

    def _forward_if_fresh(
        self, source: PeerLink | LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0
    ) -> None:
        """Drop frames from before a pause, and forward others. The process may have paused after it read them."""
        if epoch == self._stall.turn(monotonic()):
            self._switch.forward(source, frames, now, waited_s)
        else:
            name = source.name if isinstance(source, PeerLink) else source.endpoint.name
            self._stall.dropped[name] += len(frames)
            self._drops.add("frames_dropped", ShellReason.STALE, name, len(frames), now)
