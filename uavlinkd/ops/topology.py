"""The output of ``uavlinkd check``: identity, peers, the ports that the network reaches, and the policies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from uavlinkd.authority.enrolment import fingerprint_of, ids_of
from uavlinkd.config.advice import exposure
from uavlinkd.config.keys import encode_key, looks_private
from uavlinkd.config.model import Config, EndpointConfig, FleetConfig, PeerConfig, PolicyData, RelayConfig
from uavlinkd.config.network_rules import used_networks
from uavlinkd.core.certificates import parse_bulletin
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.relay.forwarding import MemberSettings

_MOST_COLUMNS: Final = 100_000  # more than any line has
_NEVER_BROKEN: Final = frozenset({"name", "public key", "address", "URL"})


def print_topology(config: Config, lacks: Sequence[str] = (), console: Console | None = None) -> None:
    """Print the topology: with colours on a terminal, as plain text elsewhere. ``lacks``: what this machine
    does not have now.

    Users compare and copy keys and URLs, so none is broken: a table may be wider than the terminal. In a pipe, each
    row and warning is one line, for ``grep``; only policies are folded. What is wrong comes first.
    """
    if console is None:
        console = Console()
    facts, policies, verdict = _facts(config), _policies(config), _verdict(config.warnings, lacks)
    columns, is_plain = console.width, not console.is_terminal
    printer = Console(no_color=True, force_terminal=False) if is_plain else console
    wide = printer.options.update(width=_MOST_COLUMNS)
    for parts, folds in (([verdict], False), (facts, False), (policies, True)):
        for part in parts:
            needed = Measurement.get(printer, wide, part)
            printer.width = columns if folds else max(columns, needed.maximum if is_plain else needed.minimum)
            with printer.capture() as captured:
                printer.print(part, crop=False)
            text = captured.get()
            # Tables pad their columns with spaces, which a file does not need.
            lines = [line.rstrip() + "\n" for line in text.splitlines()]
            console.file.writelines(lines if is_plain else [text])


def _facts(config: Config) -> list[RenderableType]:
    """The tables of what is configured, the most important first. A few peers fit on one screen.

    Text from the file is always a :class:`rich.text.Text`, so that it cannot act as markup.
    """
    parts: list[RenderableType] = [_grid(_identity(config))]
    if config.fleet is not None:
        parts += [_heading("Fleet"), _grid(_fleet(config.fleet))]
    if config.networks:
        parts += [_heading("Networks"), _grid(_networks(config), "bold")]
    if config.peers:
        links = _table(("name", "address", "suites", "mode, at least", "PSK"), map(_peer, config.peers))
        keys = _table(
            ("name", "public key"), ((peer.name, _whole(peer.settings.public_key)) for peer in config.peers)
        )
        parts += [_heading("Peers"), links]
        if not all(peer.is_called for peer in config.peers):
            port = config.listen[0].port
            parts.append(Text(f"(it connects): the peer's file needs an address of this machine, with port {port}"))
        parts += [Text(), keys]
    if config.relays:
        parts += [_heading("Relays"), _table(("name", "public key", "address", "PSK"), map(_relay, config.relays))]
    if config.endpoints:
        columns = ("name", "URL", "RADIO_STATUS", "STATUSTEXT", "plain MAVLink is open to")
        parts += [_heading("Local endpoints"), _table(columns, map(_endpoint, config.endpoints))]
    if config.relay_server is not None:
        titles = ("name", "public key", "PSK", "members", "datagrams/s", "kbit/s")
        members = _table(titles, map(_member, config.relay_server.members))
        parts += [_heading("Members of this relay, and their limits"), members]
    return parts


def _heading(text: str) -> Text:
    return Text(f"\n{text}", style="bold")


def _table(columns: Sequence[str], rows: Iterable[Sequence[str | Text]]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold", no_wrap=column in _NEVER_BROKEN)
    for cells in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in cells))
    return table


def _yes(condition: object) -> str:
    return "yes" if condition else "no"


def _whole(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed. A private key is never printed."""
    return "(private?)" if looks_private(public_key) else encode_key(public_key)


def _grid(rows: Iterable[tuple[str, str | Text]], style: str = "dim") -> Table:
    """Facts, each with its name in front."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style=style)
    table.add_column(overflow="fold")
    for name, fact in rows:
        table.add_row(Text(name), Text(fact) if isinstance(fact, str) else fact)
    return table


def _identity(config: Config) -> Iterator[tuple[str, str | Text]]:
    yield "name", Text(config.name, style="bold")
    yield "public key", encode_key(config.public_key)  # whole: the user copies it into the files of the peers
    yield "listens on", _listening(config)
    if not config.is_only_relay:
        others = ", and from peer to peer" if config.relays_frames else " only"
        yield "routing", f"between peers and endpoints{others}"
    if config.relay_server is not None and (https := config.relay_server.https) is not None:
        yield (
            "by TLS",
            f"{https.listen}{'' if https.certificate else ' (without TLS, for a web server on this machine)'}",
        )


def _fleet(fleet: FleetConfig) -> Iterator[tuple[str, str | Text]]:
    own, bulletin, ids = fleet.own.certificate, parse_bulletin(fleet.bulletin), ids_of(fleet.own.certificate)
    assert bulletin is not None  # it was checked
    yield "fingerprint", Text(fingerprint_of(fleet.authority.public), style="bold")
    systems = f"system id{'s' if '-' in ids else ''} {ids}, " if ids else ""
    yield "certificate", f"{own.name}: {own.role.name.lower()}, {systems}serial {own.serial}"
    yield "bulletin", f"number {bulletin.number} in this file, or a newer one"
    for contact in fleet.contacts:
        what = contact.role.name.lower() + (", used as a relay" if contact.relays else "")
        yield "contact", f"{contact.name}: {what}, at {', '.join(map(str, contact.addresses))}"
    called = ", ".join(sorted(role.name.lower() for role in fleet.call))
    yield "connects to", f"contacts{f', and members of the role {called}' if called else ''}"


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


def _networks(config: Config) -> Iterator[tuple[str, str]]:
    """Each network with the addresses of peers that the daemon uses on it."""
    for network in config.networks:
        if network.serial is not None:
            text = (
                f"; the radio carries {network.air_bits_s:,} bits/s, this end sends up to {network.budget_bits_s:,};"
                # With other settings the modem cuts and mixes datagrams.
                " set a SiK modem to MAVLINK=0, RTSCTS=0 and ECC=0"
            )
        else:
            budget = f"{network.budget_bits_s:,} bits/s" if network.budget_bits_s else "no budget"
            text = f", {'metered' if network.metered else 'not metered'}, {budget}"
        used = [
            f"{peer.name} {written.address}"
            for peer in config.peers
            for written in peer.addresses
            if any(used_networks([network], written))
        ]
        yield network.name, f"{network.exit}{text}\nused for {', '.join(used) or 'no address of a peer'}"


def _peer(peer: PeerConfig) -> tuple[str, ...]:
    link = peer.settings.link
    mode = "encrypted"
    if not link.confidential:
        mode = f"authentic, {8 * link.tag_bytes}-bit tag"
    return (
        peer.name,
        "\n".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)]) or "(it connects)",
        " ".join(suite.name for suite in link.suites),
        mode,
        _yes(peer.settings.psk),
    )


def _relay(relay: RelayConfig) -> tuple[str, ...]:
    addresses = "\n".join(map(str, relay.addresses))
    return relay.name, _whole(relay.settings.public_key), addresses, _yes(relay.settings.psk)


def _member(member: MemberSettings) -> tuple[str, ...]:
    limits = f"{member.most_peers:,}", f"{member.limits.datagrams_s:,}", f"{member.limits.bits_s / 1000:,.0f}"
    return member.name, _whole(member.peer.public_key), _yes(member.peer.psk), *limits


def _endpoint(endpoint: EndpointConfig) -> tuple[str | Text, ...]:
    return (
        endpoint.name,
        str(endpoint.url),
        _yes(endpoint.radio_status),
        _yes(endpoint.status_text),
        Text(exposure(endpoint), style="bold red" if endpoint.url.is_exposed else ""),
    )


def _verdict(warnings: Sequence[str], lacks: Sequence[str]) -> RenderableType:
    """All warnings, or a line that says that there is none."""
    lines = [("warning:", warning) for warning in warnings]
    lines += [("this machine:", lack) for lack in lacks]
    if not lines:
        return Text("No warnings.\n", style="green")
    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for label, line in lines:
        table.add_row(Text(label, style="bold yellow"), Text(line))
    return Padding(table, (0, 0, 1, 0), expand=False)


# Policies, for a review.

_NOT_IN_TABLES: Final = frozenset({"role", "may speak as", "urgent"})
"""Rows in the summary; and a group that sets only the order: each of its messages is in another group."""
_WHOLE: Final = (("both directions", ("all", "passes")), ("no direction", ("none", "never", "refused")))

_Rows = tuple[PolicyRow, ...]


def _policies(config: Config) -> list[RenderableType]:
    """A line for each peer and endpoint; then each policy once, with the names of its peers and endpoints."""
    senders = [("peer", peer.name, peer.policy, peer.make_policy()) for peer in config.peers]
    senders += [("endpoint", endpoint.name, endpoint.policy, endpoint.make_policy()) for endpoint in config.endpoints]
    for member, limits in config.fleet.policies.items() if config.fleet else ():
        of_role = {**limits, "system_ids": dialect.ALL}
        senders.append(("members", member.name.lower(), of_role, Policy(of_role)))
    if not senders:
        return []
    summary: list[tuple[str | Text, ...]] = []
    names_of: dict[_Rows, list[str]] = {}
    for kind, name, data, policy in senders:
        if not data:
            summary.append((kind, name, "may send everything except SETUP_SIGNING", "any"))
            continue
        incoming = {row.subject: row.incoming for row in policy.describe()}
        role: str | Text = incoming["role"]
        if kind == "peer" and role == dialect.ALL:
            role = Text("all: everything except SETUP_SIGNING", style="bold yellow")
        systems = "of its certificate" if kind == "members" else incoming["may speak as"]
        summary.append((kind, name, role, systems))
        names_of.setdefault(table_rows(policy, data), []).append(f"members: {name}" if kind == "members" else name)
    parts: list[RenderableType] = [_heading("Roles"), _table(("", "name", "role", "system ids"), summary)]
    for rows, names in names_of.items():
        parts += [_heading(f"Policy of {', '.join(names)}"), *_policy_tables(rows)]
    return parts


def _policy_tables(rows: _Rows) -> list[RenderableType]:
    """The groups that pass in both directions, those that pass in none, and a table of the rest."""
    alike: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        alike.setdefault((row.incoming, row.outgoing), []).append(row.subject)
    whole = Table.grid(padding=(0, 2))
    for title, verdicts in _WHOLE:
        if subjects := [subject for verdict in verdicts for subject in alike.pop((verdict, verdict), ())]:
            whole.add_row(Text(title), Text(", ".join(subjects)))
    alike.pop(("-", "-"), None)
    if not alike:
        return [whole]
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, expand=True)
    widest = max(len(f"{word},") for subjects in alike.values() for subject in subjects for word in subject.split())
    table.add_column("otherwise", width=widest, overflow="fold")
    for column in ("from it", "to it"):
        table.add_column(column, ratio=1, overflow="fold")
    for sides, subjects in alike.items():
        table.add_row(*map(Text, (", ".join(subjects), *sides)))
    return [whole, table]


def table_rows(policy: Policy, data: PolicyData) -> _Rows:
    """The rows of the policy, whose source is ``data``.

    A message passes in a direction if a row allows its group or its name, and no row refuses a whole group that
    contains it.
    """
    role = ROLES.get(str(data.get("role")))
    # As in the file: a group may have a hundred messages, each with this rate.
    rates = _rates(data.get("rate_in"), role.rate_in if role else {}), _rates(data.get("rate_out"), {})
    return *(row for row in policy.describe() if row.subject not in _NOT_IN_TABLES), PolicyRow("rates", *rates)


def _rates(written: object, by_role: Mapping[str, float]) -> str:
    """The rates of the file, and those of the role that the file does not replace."""
    own = written if isinstance(written, Mapping) else {}
    replaced = {name for key in own for name in _members(str(key))}
    left = {key: rate for key, rate in by_role.items() if not replaced.issuperset(_members(key))}
    return ", ".join(f"{name} {rate:g}/s" for name, rate in {**own, **left}.items()) or "-"


def _members(name: str) -> tuple[str, ...]:
    """The messages that a rate applies to."""
    return dialect.GROUPS.get(name, (name,))
