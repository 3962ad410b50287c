"""The output of ``uavlinkd check``: the identity of the daemon, its peers, and its ports that the network reaches."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from uavlinkd.config import Config, PeerConfig, Routing
from uavlinkd.config.advice import exposure
from uavlinkd.config.keys import encode_key, looks_private, short_form
from uavlinkd.config.network_rules import used_networks
from uavlinkd.core.constants import AEAD_TAG_BYTES
from uavlinkd.core.crypto import x25519_public_key
from uavlinkd.core.settings import Link
from uavlinkd.core.wire import LONG_HEADER_BYTES, SHORT_HEADER_BYTES, initiation_bytes, response_bytes
from uavlinkd.ops.network_report import NetworkReport
from uavlinkd.ops.policy_table import review
from uavlinkd.ops.relay_table import members_configured, relays_configured

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
        parts += [_heading("Peers"), _peers(config), _heading("Bytes in a datagram"), _sizes(config)]
        parts += [_heading("Sending to a peer"), _pace(config)]
    if config.relays:
        parts += [_heading("Relays"), relays_configured(config.relays)]
    if config.endpoints:
        parts += [_heading("Local endpoints"), _endpoints(config)]
    if config.relay_server is not None:
        parts += [_heading("Members of this relay, and their limits"), members_configured(config.relay_server)]
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
        table.add_row("previous key", Text(f"{before}\n{_grace(config)}"))
    table.add_row("listens on", Text(_listening(config)))
    if not config.is_only_relay:
        table.add_row("routing", Text(_routing(config.routing)))
    if config.metrics is not None:
        table.add_row("metrics", Text(f"http://{config.metrics}/metrics"))
    if config.recording is not None:
        free = f"keeps {config.recording.min_free_bytes / 1e9:g} GB of the disk free"
        table.add_row("recordings", Text(f"{config.recording.folder} ({free})"))
    return table


def _grace(config: Config) -> str:
    """How long previous keys are valid."""
    days, seconds = divmod(config.key_grace_s, 86400)
    most = f"{config.key_grace_s:g} s" if seconds or not days else f"{days:g} day{'s' if days > 1 else ''}"
    return f"valid until the peer confirms the new key, at most {most} from each start"


def _routing(routing: Routing) -> str:
    relay = (
        "between peers and endpoints, and from peer to peer" if routing.relay else "between peers and endpoints only"
    )
    unknown = "goes to all others" if routing.unknown_targets == "flood" else "is dropped"
    return f"{relay}; a frame for an unknown system {unknown}"


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


def _peers(config: Config) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("name", "key", "address", "suites", "mode, at least", "PSK"):
        table.add_column(column, overflow="fold")
    for peer in config.peers:
        settings = peer.settings
        cells = (
            peer.name,
            _keys(peer),
            "\n".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)])
            or "(it connects)",
            " ".join(suite.name for suite in settings.link.suites),
            _mode(settings.link),
            "yes" if settings.psk is not None else "no",
        )
        table.add_row(*map(Text, cells))
    return table


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


def _sizes(config: Config) -> Table:
    """Bytes on the air."""
    texts = []
    for peer in config.peers:
        link = peer.settings.link
        tag_bytes = AEAD_TAG_BYTES if link.confidential else link.tag_bytes
        offered = link.suites[0]
        texts.append(
            f"envelopes up to {link.max_envelope:,}, adding"
            f" {SHORT_HEADER_BYTES + tag_bytes}-{LONG_HEADER_BYTES + tag_bytes} to the frames;"
            f" handshake {initiation_bytes(offered):,} + {response_bytes(offered):,}"
        )
    return _by_peer(config, texts)


def _pace(config: Config) -> Table:
    """Budgets, and how long frames wait."""
    texts = []
    for peer in config.peers:
        egress = peer.egress
        if not egress.is_needed:
            texts.append("each frame at once")
            continue
        budget = f"up to {egress.budget_bits_s:,} bits/s" if egress.budget_bits_s else "no budget"
        coalesce = f"; up to {egress.coalesce_s:g} s to share an envelope" if egress.coalesce_s else ""
        texts.append(f"{budget}{coalesce}; dropped after {egress.max_age_s:g} s")
    return _by_peer(config, texts)


def _by_peer(config: Config, texts: Sequence[str]) -> Table:
    """One line per text, with the names of the peers that share it."""
    alike: dict[str, list[str]] = {}
    for peer, text in zip(config.peers, texts, strict=True):
        alike.setdefault(text, []).append(peer.name)
    table = Table.grid(padding=(0, 2))
    for text, names in alike.items():
        table.add_row(Text("every peer" if len(alike) == 1 else ", ".join(names)), Text(text))
    return table


def _endpoints(config: Config) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("name", "URL", "keeps frames", "RADIO_STATUS", "STATUSTEXT", "plain MAVLink is open to"):
        table.add_column(column, overflow="fold")
    for endpoint in config.endpoints:
        style = "bold red" if endpoint.url.is_exposed else ""
        cells = (
            endpoint.name,
            str(endpoint.url),
            f"{endpoint.max_age_s:g} s",
            "yes" if endpoint.radio_status else "no",
            "yes" if endpoint.status_text else "no",
        )
        table.add_row(*map(Text, cells), Text(exposure(endpoint), style=style))
    return table


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
