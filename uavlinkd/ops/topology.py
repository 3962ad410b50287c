"""What ``uavlinkd check`` prints: who this daemon is, with whom it links, and what is open to the network."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from uavlinkd.config import Config, Peer, Routing
from uavlinkd.config.advice import exposure
from uavlinkd.core.constants import AEAD_TAG_BYTES
from uavlinkd.core.crypto import x25519_public_key
from uavlinkd.core.settings import Link
from uavlinkd.core.wire import LONG_HEADER_BYTES, SHORT_HEADER_BYTES, initiation_bytes, response_bytes
from uavlinkd.config.keys import encode_key, short_form
from uavlinkd.ops.policy_table import review

_PLAIN_WIDTH = 100
"""Columns where the output is no terminal: a pipe does not tell."""


def print_topology(config: Config, console: Console | None = None) -> None:
    """Print it: with colours on a terminal, as plain text elsewhere."""
    if console is None:
        console = Console()
    if console.is_terminal:
        console.print(describe(config))
        return
    plain = Console(width=_PLAIN_WIDTH, no_color=True, force_terminal=False)
    with plain.capture() as captured:
        plain.print(describe(config))
    # Tables fill their columns with spaces, which a file does not need.
    console.file.writelines(line.rstrip() + "\n" for line in captured.get().splitlines())


def describe(config: Config) -> Group:
    """The whole picture, most important first, in one screen for a handful of peers.

    Whatever the file names is put in as :class:`rich.text.Text`, so that nothing in it is taken for markup.
    """
    parts: list[RenderableType] = [_identity(config)]
    if config.peers:
        parts += [_heading("Peers"), _peers(config), _heading("Bytes in a datagram"), _sizes(config)]
        parts += [_heading("On the way to a peer"), _pace(config)]
    if config.endpoints:
        parts += [_heading("Local endpoints"), _endpoints(config)]
    parts += review(config)
    parts.append(_verdict(config))
    return Group(*parts)


def _heading(text: str) -> Text:
    return Text(f"\n{text}", style="bold")


def _identity(config: Config) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    table.add_row("name", Text(config.name, style="bold"))
    # Whole, on a line of its own: it is what is copied into the peers' files.
    table.add_row("public key", Text(encode_key(config.public_key)))
    if config.previous_private_key is not None:
        before = encode_key(x25519_public_key(config.previous_private_key.reveal()))
        table.add_row("before", Text(f"{before}\n{_grace(config)}"))
    table.add_row("listens on", Text(_listening(config)))
    table.add_row("routing", Text(_routing(config.routing)))
    if config.metrics is not None:
        table.add_row("metrics", Text(f"http://{config.metrics}/metrics"))
    if config.recording is not None:
        left = f"{config.recording.min_free_bytes / 1e9:g} GB of its disk are left to others"
        table.add_row("records in", Text(f"{config.recording.folder} ({left})"))
    return table


def _grace(config: Config) -> str:
    """How long previous keys are good."""
    days, seconds = divmod(config.key_grace_s, 86400)
    most = f"{config.key_grace_s:g} s" if seconds or not days else f"{days:g} day{'s' if days > 1 else ''}"
    return f"good too, until the new one is confirmed: {most} at most from each start"


def _routing(routing: Routing) -> str:
    relay = (
        "from peers to other peers too" if routing.relay else "between peers and endpoints, from no peer to another"
    )
    unknown = "to all others" if routing.unknown_targets == "flood" else "nowhere"
    return f"{relay}; a frame for a system not heard yet goes {unknown}"


def _listening(config: Config) -> str:
    if not config.listen:
        return "nothing: it calls its peers, from any free port"
    where = ", ".join(str(address) for address in config.listen)
    if all(address.is_loopback for address in config.listen):
        return f"{where} (UDP, this machine only)"
    return f"{where} (UDP, open to the network; answers nobody who does not know the public key)"


def _peers(config: Config) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("name", "key", "called at", "suites", "mode, at least", "PSK"):
        table.add_column(column, overflow="fold")
    for peer in config.peers:
        settings = peer.settings
        cells = (
            peer.name,
            _keys(peer),
            "\n".join(map(str, peer.addresses)) or "(it calls)",
            " ".join(suite.name for suite in settings.link.suites),
            _mode(settings.link),
            "yes" if settings.psk is not None else "no",
        )
        table.add_row(*map(Text, cells))
    return table


def _keys(peer: Peer) -> str:
    """The peer's key, and below it the one that it had, where that is accepted still."""
    now, before = peer.settings.public_key, peer.previous_public_key
    return short_form(now) if before is None else f"{short_form(now)}\nor {short_form(before)}"


def _mode(link: Link) -> str:
    if link.confidential:
        return "encrypted"
    key = "" if link.mac_key_bits == Link().mac_key_bits else f", {link.mac_key_bits}-bit key"
    return f"authentic, {8 * link.tag_bytes}-bit tag{key}"


def _sizes(config: Config) -> Table:
    """What goes over the air."""
    said = []
    for peer in config.peers:
        link = peer.settings.link
        tag_bytes = AEAD_TAG_BYTES if link.confidential else link.tag_bytes
        offered = link.suites[0]
        said.append(
            f"envelopes up to {link.max_envelope:,}, adding"
            f" {SHORT_HEADER_BYTES + tag_bytes}-{LONG_HEADER_BYTES + tag_bytes} to the frames;"
            f" handshake {initiation_bytes(offered):,} + {response_bytes(offered):,}"
        )
    return _by_peer(config, said)


def _pace(config: Config) -> Table:
    """How fast frames go, and how long they wait."""
    said = []
    for peer in config.peers:
        egress = peer.egress
        if not egress.is_needed:
            said.append("each frame at once")
            continue
        budget = f"up to {egress.budget_bits_s:,} bits/s" if egress.budget_bits_s else "no budget"
        coalesce = f"; up to {egress.coalesce_s:g} s to share an envelope" if egress.coalesce_s else ""
        said.append(f"{budget}{coalesce}; what waited {egress.max_age_s:g} s is dropped")
    return _by_peer(config, said)


def _by_peer(config: Config, said: Sequence[str]) -> Table:
    """What is said of each peer, those of which the same is said together."""
    alike: dict[str, list[str]] = {}
    for peer, text in zip(config.peers, said, strict=True):
        alike.setdefault(text, []).append(peer.name)
    table = Table.grid(padding=(0, 2))
    for text, names in alike.items():
        table.add_row(Text("every peer" if len(alike) == 1 else ", ".join(names)), Text(text))
    return table


def _endpoints(config: Config) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("name", "URL", "keeps frames", "RADIO_STATUS", "plain MAVLink is open to"):
        table.add_column(column, overflow="fold")
    for endpoint in config.endpoints:
        style = "bold red" if endpoint.url.is_exposed else ""
        cells = (
            endpoint.name,
            str(endpoint.url),
            f"{endpoint.max_age_s:g} s",
            "yes" if endpoint.radio_status else "no",
        )
        table.add_row(*map(Text, cells), Text(exposure(endpoint), style=style))
    return table


def _verdict(config: Config) -> RenderableType:
    """Every warning, or that there is none."""
    if not config.warnings:
        return Text("\nNo warnings.", style="green")
    warnings = Table.grid(padding=(0, 1))
    warnings.add_column(style="bold yellow", no_wrap=True)
    warnings.add_column(overflow="fold")
    for warning in config.warnings:
        warnings.add_row("warning:", Text(warning))
    return Padding(warnings, (1, 0, 0, 0))
