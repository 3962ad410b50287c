"""The members of a relay for people: in ``uavlinkd status`` and ``uavlinkd check``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from uavlinkd.config import RelayConfig, RelayServer
from uavlinkd.config.keys import encode_key, looks_private
from uavlinkd.ops.reason_phrases import DATAGRAMS, phrase

SHOWN_MEMBERS = 30


def members_status(relay: dict[str, Any]) -> Table:
    """A line per member, those that are down first."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=0)
    for title in ("member", "state", "address", "bound", "waiting", "forwarded", "over\nlimit"):
        justify: JustifyMethod = "left" if title in ("member", "state", "address") else "right"
        table.add_column(title, justify=justify, overflow="fold", no_wrap=title == "state")
    members = sorted(relay["members"].items(), key=lambda item: (item[1]["is_up"], item[0]))
    for name, member in members[:SHOWN_MEMBERS]:
        table.add_row(
            Text(name),
            Text(f"{'up' if member['is_up'] else 'down'} {age(member['since_s'])}", _style(is_up=member["is_up"])),
            Text("\n".join(dict.fromkeys(member["addresses"])) or "-"),
            f"{member['bound']:,}",
            f"{member['waiting']:,}",
            f"{member['datagrams']:,}",
            Text(f"{member['over_limit']:,}", style="yellow" if member["over_limit"] else ""),
        )
    if len(members) > SHOWN_MEMBERS:
        table.add_row(f"and {len(members) - SHOWN_MEMBERS:,} more")
    return table


def _style(*, is_up: bool) -> str:
    return "green" if is_up else "yellow"


def age(seconds: float) -> str:
    """A duration for a column, at most 6 characters long within a year."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.0f} h"


def relay_drops(relay: dict[str, Any]) -> str:
    """What the relay dropped, in plain words; empty for nothing."""
    counts = sorted(relay["dropped"].items(), key=lambda item: -item[1])
    return ", ".join(f"{count:,} {phrase(reason, DATAGRAMS)}" for reason, count in counts)


def members_configured(server: RelayServer) -> Table:
    """A line per member of a configuration."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("name", "public key", "PSK", "members", "datagrams/s", "kbit/s"):
        table.add_column(title, overflow="fold", justify="right" if "/" in title or title == "members" else "left")
    for member in server.members:
        table.add_row(
            Text(member.name),
            Text(_whole(member.peer.public_key)),
            "yes" if member.peer.psk is not None else "no",
            f"{member.most_peers:,}",
            f"{member.limits.datagrams_s:,}",
            f"{member.limits.bits_s / 1000:,.0f}",
        )
    return table


def relays_configured(relays: Sequence[RelayConfig]) -> Table:
    """A line per relay that a configuration uses."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for title in ("name", "public key", "address", "PSK"):
        table.add_column(title, overflow="fold")
    for relay in relays:
        settings = relay.settings
        table.add_row(
            Text(relay.name),
            Text(_whole(settings.public_key)),
            Text("\n".join(map(str, relay.addresses))),
            "yes" if settings.psk is not None else "no",
        )
    return table


def _whole(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed."""
    return "(private?)" if looks_private(public_key) else encode_key(public_key)


def used_relay(name: str, relay: dict[str, Any]) -> Text:
    """A line about a relay that this daemon uses, with the state of each peer there."""
    time_s = relay["round_trip_s"]
    measured = "" if time_s is None else f", {1000 * time_s:.0f} ms"
    peers = ", ".join(f"{peer} {state}" for peer, state in relay["peers"].items()) or "no peer uses it"
    is_well = relay["state"] == "up" and "unanswered" not in relay["peers"].values()
    role = "" if relay["peer"] is None else f", also the peer {relay['peer']}"
    return Text(f"relay {name}{role}: {relay['state']}{measured}; {peers}", style="" if is_well else "yellow")
