"""The output of ``uavlinkd check``: the identity of the daemon, its peers, and its ports that the network reaches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from uavlinkd.config import Config, PeerConfig, RelayConfig, RelayServer, Routing
from uavlinkd.config.advice import exposure
from uavlinkd.config.keys import encode_key, looks_private, short_form
from uavlinkd.config.model import KEY_GRACE_S
from uavlinkd.config.network_rules import used_networks
from uavlinkd.core.crypto import x25519_public_key
from uavlinkd.core.settings import Link
from uavlinkd.ops.network_report import NetworkReport
from uavlinkd.ops.policy_table import review

_PLAIN_WIDTH = 100
"""Columns of the output if it is not a terminal: a pipe has no width."""


def print_topology(
    config: Config,
    console: Console | None = None,
    lacks: Sequence[str] = (),
    networks: NetworkReport | None = None,
) -> None:
    """Print the topology: with colours on a terminal, as plain text elsewhere.

    ``lacks``: what this machine lacks for it, see :mod:`uavlinkd.ops.surroundings`. ``networks``: what they reach
    here.
    """
    if console is None:
        console = Console()
    if console.is_terminal:
        console.print(describe(config, lacks, networks))
        return
    plain = Console(width=_PLAIN_WIDTH, no_color=True, force_terminal=False)
    with plain.capture() as captured:
        plain.print(describe(config, lacks, networks))
    # Tables pad their columns with spaces, which a file does not need.
    console.file.writelines(line.rstrip() + "\n" for line in captured.get().splitlines())


def describe(config: Config, lacks: Sequence[str] = (), networks: NetworkReport | None = None) -> Group:
    """All tables, the most important first. A few peers fit on one screen.

    Text from the file is always a :class:`rich.text.Text`, so that it cannot act as markup.
    """
    parts: list[RenderableType] = [_identity(config)]
    if config.networks:
        parts += [_heading("Networks"), _networks(config, networks)]
    if config.peers:
        parts += [_heading("Peers"), _peers(config)]
    if config.relays:
        parts += [_heading("Relays"), _relays(config.relays)]
    if config.endpoints:
        parts += [_heading("Local endpoints"), _endpoints(config)]
    if config.relay_server is not None:
        parts += [_heading("Members of this relay, and their limits"), _members(config.relay_server)]
    parts += review(config)
    parts.append(_verdict(config, lacks, () if networks is None else networks.errors))
    return Group(*parts)


def _heading(text: str) -> Text:
    return Text(f"\n{text}", style="bold")


def _identity(config: Config) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    table.add_row("name", Text(config.name, style="bold"))
    # Not shortened: the user copies it into the files of the peers.
    table.add_row("public key", Text(encode_key(config.public_key)))
    if config.previous_private_key is not None:
        before = encode_key(x25519_public_key(config.previous_private_key.reveal()))
        table.add_row("previous key", Text(f"{before}\n{_GRACE}"))
    table.add_row("listens on", Text(_listening(config)))
    if not config.is_only_relay:
        table.add_row("routing", Text(_routing(config.routing)))
    if config.metrics is not None:
        table.add_row("metrics", Text(f"http://{config.metrics}/metrics"))
    if config.recording is not None:
        free = f"keeps {config.recording.min_free_bytes / 1e9:g} GB of the disk free"
        table.add_row("recordings", Text(f"{config.recording.folder} ({free})"))
    return table


_GRACE = f"valid until the peer confirms the new key, at most {KEY_GRACE_S / 86400:g} days from each start"


def _routing(routing: Routing) -> str:
    return (
        "between peers and endpoints, and from peer to peer" if routing.relay else "between peers and endpoints only"
    )


def _listening(config: Config) -> str:
    if config.has_ip_networks and config.listen:
        ports = (f"port {address.port} ({'IPv6' if ':' in address.host else 'IPv4'})" for address in config.listen)
        return f"{', '.join(ports)} of each network (UDP; answers only senders that know the public key)"
    if not config.listen:
        return "nothing: it connects to its peers, from any free port"
    where = ", ".join(str(address) for address in config.listen)
    if all(address.is_loopback for address in config.listen):
        return f"{where} (UDP, this machine only)"
    return f"{where} (UDP, open to the network; answers only senders that know the public key)"


def _networks(config: Config, report: NetworkReport | None) -> Table:
    """Each network with the peers' addresses that are used on it; on this machine, those that it reaches now."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for number, network in enumerate(config.networks):
        budget = f"{network.budget_bits_s:,} bits/s" if network.budget_bits_s else "no budget"
        text = Text(f"{network.exit}, {'metered' if network.metered else 'not metered'}, {budget}")
        if network.serial is not None:
            text = Text(network.exit)
        if report is None:
            used = [
                f"{peer.name} {written.address}"
                for peer in config.peers
                for written in peer.addresses
                if any(used_networks([network], written))
            ]
            text.append(f"\nused for {', '.join(used) or 'no address of a peer'}")
        else:
            reach = report.reaches[number]
            text.append(f"; {reach.here}")
            if reach.reached:
                text.append(f"\nreaches {', '.join(reach.reached)}")
            if reach.unreached:
                text.append(f"\ndoes not reach {', '.join(reach.unreached)}", style="bold red")
        table.add_row(Text(network.name), text)
    return table


def _table(columns: Sequence[str], rows: Iterable[Sequence[str | Text]]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    for cells in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in cells))
    return table


def _yes(condition: object) -> str:
    return "yes" if condition else "no"


def _peers(config: Config) -> Table:
    return _table(
        ("name", "key", "address", "suites", "mode, at least", "PSK"),
        (
            (
                peer.name,
                _keys(peer),
                "\n".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)])
                or "(it connects)",
                " ".join(suite.name for suite in peer.settings.link.suites),
                _mode(peer.settings.link),
                _yes(peer.settings.psk),
            )
            for peer in config.peers
        ),
    )


def _keys(peer: PeerConfig) -> str:
    """The peer's key, and below it the previous one while that is accepted."""
    now, before = peer.settings.public_key, peer.previous_public_key
    if looks_private(now):  # perhaps it is: then not even its beginning is printed
        return "(private?)"
    return short_form(now) if before is None else f"{short_form(now)}\nor {short_form(before)}"


def _mode(link: Link) -> str:
    if link.confidential:
        return "encrypted"
    key = "" if link.mac_key_bits == Link().mac_key_bits else f", {link.mac_key_bits}-bit key"
    return f"authentic, {8 * link.tag_bytes}-bit tag{key}"


def _endpoints(config: Config) -> Table:
    return _table(
        ("name", "URL", "RADIO_STATUS", "STATUSTEXT", "plain MAVLink is open to"),
        (
            (
                endpoint.name,
                str(endpoint.url),
                _yes(endpoint.radio_status),
                _yes(endpoint.status_text),
                Text(exposure(endpoint), style="bold red" if endpoint.url.is_exposed else ""),
            )
            for endpoint in config.endpoints
        ),
    )


def _members(server: RelayServer) -> Table:
    return _table(
        ("name", "public key", "PSK", "members", "datagrams/s", "kbit/s"),
        (
            (
                member.name,
                _whole(member.peer.public_key),
                _yes(member.peer.psk),
                f"{member.most_peers:,}",
                f"{member.limits.datagrams_s:,}",
                f"{member.limits.bits_s / 1000:,.0f}",
            )
            for member in server.members
        ),
    )


def _relays(relays: Sequence[RelayConfig]) -> Table:
    return _table(
        ("name", "public key", "address", "PSK"),
        (
            (
                relay.name,
                _whole(relay.settings.public_key),
                "\n".join(map(str, relay.addresses)),
                _yes(relay.settings.psk),
            )
            for relay in relays
        ),
    )


def _whole(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed."""
    return "(private?)" if looks_private(public_key) else encode_key(public_key)


def _verdict(config: Config, lacks: Sequence[str], errors: Sequence[str]) -> RenderableType:
    """All errors and warnings, or a line that says that there is no warning."""
    if not config.warnings and not lacks and not errors:
        return Text("\nNo warnings.", style="green")
    warnings = Table.grid(padding=(0, 1))
    warnings.add_column(style="bold yellow", no_wrap=True)
    warnings.add_column(overflow="fold")
    for error in errors:
        warnings.add_row(Text("error:", style="bold red"), Text(error))
    for warning in config.warnings:
        warnings.add_row("warning:", Text(warning))
    for lack in lacks:
        warnings.add_row("this machine:", Text(lack))
    return Padding(warnings, (1, 0, 0, 0))
