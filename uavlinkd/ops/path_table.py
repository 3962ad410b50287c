"""The paths of a peer on the screen of ``uavlinkd status``: a line for each path of a peer that has several."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from uavlinkd.ops.path_names import addresses

Status = dict[str, Any]

_WIDE: Final = 100
"""From so many columns on, the table has lag and bytes too."""
_STYLES: Final = {"usable": "green", "suspect": "yellow", "down": "bold red", "unproven": "yellow"}
_REASONS: Final[Mapping[str, str]] = {
    "unanswered": "no answer",
    "loss": "loss",
    "network": "no network",
}
"""Why a path is not usable, in plain words."""


class PathTable:
    """The paths of all peers that have several; it fits into 80 columns. Pairs of numbers are in/out."""

    def __init__(self, peers: Mapping[str, Status]) -> None:
        self._peers = peers

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table with as many columns as have room."""
        is_wide = options.max_width >= _WIDE
        table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column("path", overflow="fold")
        names = ["state", "carries", "rtt ms", "loss %", "kB/s"]
        for name in names + ["lag ms", "MB"] * is_wide:
            table.add_column(name, no_wrap=True)
        for name, peer in self._peers.items():
            table.add_row(Text(name, style="bold"))
            for path, address in zip(peer["paths"], addresses(peer["paths"]), strict=True):
                cells = _cells(path, address)
                table.add_row(*(cells if is_wide else cells[: len(names) + 1]))
        yield table


def has_several_paths(peer: Status) -> bool:
    """Whether the table has a line for each path of the peer."""
    return len(peer["paths"]) > 1


def _cells(path: Status, address: str) -> list[Text]:
    where = f"{path['network']} {address}" if path["network"] else address
    return [
        Text(f" {where}", style="bold" if path["role"] == "best" else ""),
        Text(_state(path), style=_STYLES[path["state"]]),
        Text(_carries(path["carries"])),
        Text("-" if path["round_trip_s"] is None else f"{_ms(path['round_trip_s'])}±{_ms(path['jitter_s'])}"),
        Text(f"{100 * path['loss_in']:.0f}/{100 * path['loss_out']:.0f}"),
        Text(f"{_short(path['bytes_in_s'] / 1e3)}/{_short(path['bytes_out_s'] / 1e3)}"),
        Text("-" if path["lag_s"] is None else _ms(path["lag_s"])),
        Text(f"{_short(path['bytes_received'] / 1e6)}/{_short(path['bytes_sent'] / 1e6)}"),
    ]


def _state(path: Status) -> str:
    """The role of a usable path; of another one, what is wrong."""
    if path["state"] == "usable":
        return str(path["role"])
    reason = _REASONS.get(path["reason"])
    return f"{path['state']}: {reason}" if reason else str(path["state"])


def _carries(classes: list[str]) -> str:
    """The classes of frames that go along a path."""
    if len(classes) == 3:
        return "all"
    return "+".join(classes) or "-"


def _ms(seconds: float) -> str:
    return _short(1000 * seconds)


def _short(number: float) -> str:
    """One digit behind the point below ten, none above."""
    return f"{number:.1f}" if number < 9.95 else f"{number:.0f}"
