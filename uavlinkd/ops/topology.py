"""The output of ``uavlinkd check``: identity, peers, the ports that the network reaches, and the policies."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Final

from uavlinkd.authority.certificates import parse_bulletin
from uavlinkd.authority.enrolment import fingerprint_of, ids_of
from uavlinkd.config.keys import encode_key, looks_private
from uavlinkd.config.model import Config, EndpointConfig, FleetConfig, NetworkConfig, PeerConfig, PolicyData
from uavlinkd.io.url import SerialUrl
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.system.terminal import printable

Row = tuple[str, ...]


def print_topology(config: Config, lacks: Sequence[str] = (), columns: int | None = None) -> None:
    """Print the topology as plain text, the warnings first. ``lacks``: what this machine does not have now.

    Users compare and copy keys and URLs, so each row and warning is one line; only policies are folded.
    """
    columns = columns or shutil.get_terminal_size().columns
    verdict = [*(f"warning: {warning}" for warning in config.warnings), *(f"this machine: {lack}" for lack in lacks)]
    for line in (*(verdict or ["No warnings."]), "", *_facts(config), *_policies(config, columns)):
        print(printable(line))


def _facts(config: Config) -> Iterator[str]:
    """The tables of what is configured, the most important first."""
    yield from _table("", [], list(_identity(config)))
    if config.fleet is not None:
        yield from _table("Fleet", [], list(_fleet(config.fleet)))
    yield from _table("Networks", [], list(map(_network, config.networks)))
    titles = ["name", "public key", "address", "suites", "mode, at least", "PSK"]
    yield from _table("Peers", titles, list(map(_peer, config.peers)))
    if not all(peer.is_called for peer in config.peers):
        port = config.listen[0].port
        yield f"(it connects): the peer's file needs an address of this machine, with port {port}"
    relays = [
        (one.name, _whole(one.settings.public_key), ", ".join(map(str, one.addresses))) for one in config.relays
    ]
    yield from _table("Relays", ["name", "public key", "address"], relays)
    titles = ["name", "URL", "RADIO_STATUS", "STATUSTEXT", "plain MAVLink is open to"]
    yield from _table("Local endpoints", titles, list(map(_endpoint, config.endpoints)))
    if config.relay_server is not None:
        members = [
            (one.name, _whole(one.peer.public_key), f"{one.bits_s / 1000:,.0f}")
            for one in config.relay_server.members
        ]
        titles = ["name", "public key", "kbit/s"]
        yield from _table("Members of this relay, and their limits", titles, members)


def _table(title: str, columns: Sequence[str], rows: Sequence[Row]) -> Iterator[str]:
    """A line for each row, with columns of equal width; nothing without a row."""
    if rows:
        table = [*([columns] if columns else []), *rows]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        yield from ("", title) if title else ()
        yield from ("  ".join(map(str.ljust, row, widths)).rstrip() for row in table)


def _yes(condition: object) -> str:
    return "yes" if condition else "no"


def _whole(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed. A private key is never printed."""
    return "(private?)" if looks_private(public_key) else encode_key(public_key)


def _identity(config: Config) -> Iterator[Row]:
    yield "name", config.name
    yield "public key", encode_key(config.public_key)  # whole: the user copies it into the files of the peers
    yield "listens on", _listening(config)
    if not config.is_only_relay:
        others = ", and from peer to peer" if config.relays_frames else " only"
        yield "routing", f"between peers and endpoints{others}"
    if config.relay_server is not None and (https := config.relay_server.https) is not None:
        yield "by TLS", str(https.listen)


def _fleet(fleet: FleetConfig) -> Iterator[Row]:
    own, bulletin, ids = fleet.own.certificate, parse_bulletin(fleet.bulletin), ids_of(fleet.own.certificate)
    assert bulletin is not None  # it was checked
    yield "fingerprint", fingerprint_of(fleet.authority.public)
    systems = f"system id{'s' if '-' in ids else ''} {ids}, " if ids else ""
    yield "certificate", f"{own.name}: {own.role.name.lower()}, {systems}serial {own.serial}"
    yield "bulletin", f"number {bulletin.number} in this file, or a newer one"
    for contact in fleet.contacts:
        what = contact.role.name.lower() + (", used as a relay" if contact.relays else "")
        yield "contact", f"{contact.name}: {what}, at {', '.join(map(str, contact.addresses))}"
    called = ", ".join(sorted(role.name.lower() for role in fleet.call))
    yield "connects to", f"contacts{f', and members of the role {called}' if called else ''}"


def _listening(config: Config) -> str:
    if not config.listen:
        return "nothing: it connects to its peers, from any free port"
    where = ", ".join(str(address) for address in config.listen)
    if config.has_ip_networks:
        where += " of each network"
    elif all(address.is_loopback for address in config.listen):
        return f"{where} (UDP, this machine only)"
    return f"{where} (UDP, open to the network; answers only senders that know the public key)"


def _network(network: NetworkConfig) -> Row:
    if network.serial is not None:
        # With other settings the modem cuts and mixes datagrams.
        return network.name, (
            f"{network.exit}; the radio carries {network.air_bits_s:,} bits/s, this end sends up to"
            f" {network.budget_bits_s:,}; set a SiK modem to MAVLINK=0, RTSCTS=0 and ECC=0"
        )
    budget = f"{network.budget_bits_s:,} bits/s" if network.budget_bits_s else "no budget"
    return network.name, f"{network.exit}, {'metered' if network.metered else 'not metered'}, {budget}"


def _peer(peer: PeerConfig) -> Row:
    link = peer.settings.link
    return (
        peer.name,
        _whole(peer.settings.public_key),
        ", ".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)]) or "(it connects)",
        " ".join(suite.name for suite in link.suites),
        "encrypted" if link.confidential else f"authentic, {8 * link.tag_bytes}-bit tag",
        _yes(peer.settings.psk),
    )


def _exposure(endpoint: EndpointConfig) -> str:
    """Where an endpoint can be reached from, in two or three words."""
    if isinstance(endpoint.url, SerialUrl):
        return "wire"
    return "THE NETWORK" if endpoint.url.is_exposed else "this machine"


def _endpoint(endpoint: EndpointConfig) -> Row:
    is_told = _yes(endpoint.radio_status), _yes(endpoint.status_text)
    return endpoint.name, str(endpoint.url), *is_told, _exposure(endpoint)


# Policies, for a review.

_NOT_IN_TABLES: Final = frozenset({"role", "may speak as", "urgent"})
"""Rows in the summary; and a group that sets only the order: each of its messages is in another group."""


def _policies(config: Config, columns: int) -> Iterator[str]:
    """A line for each peer and endpoint; then each policy once, with the names of its peers and endpoints."""
    senders = [("peer", peer.name, peer.policy, peer.make_policy()) for peer in config.peers]
    senders += [("endpoint", endpoint.name, endpoint.policy, endpoint.make_policy()) for endpoint in config.endpoints]
    for member, limits in config.fleet.policies.items() if config.fleet else ():
        of_role = {**limits, "system_ids": dialect.ALL}
        senders.append(("members", member.name.lower(), of_role, Policy(of_role)))
    summary: list[Row] = []
    names_of: dict[tuple[PolicyRow, ...], list[str]] = {}
    for kind, name, data, policy in senders:
        if not data:
            summary.append((kind, name, "may send everything except SETUP_SIGNING", "any"))
            continue
        incoming = {row.subject: row.incoming for row in policy.describe()}
        systems = "of its certificate" if kind == "members" else incoming["may speak as"]
        summary.append((kind, name, incoming["role"], systems))
        names_of.setdefault(table_rows(policy, data), []).append(f"members: {name}" if kind == "members" else name)
    yield from _table("Roles", ("", "name", "role", "system ids"), summary)
    for rows, names in names_of.items():
        yield from ("", f"Policy of {', '.join(names)}")
        alike: dict[tuple[str, str], list[str]] = {}
        for row in rows:
            alike.setdefault((row.incoming, row.outgoing), []).append(row.subject)
        for (way_in, way_out), subjects in alike.items():
            line = f"{', '.join(subjects)}: from it {way_in}; to it {way_out}"
            yield from wrap(line, columns, subsequent_indent="    ", break_on_hyphens=False)


def table_rows(policy: Policy, data: PolicyData) -> tuple[PolicyRow, ...]:
    """The rows of the policy, whose source is ``data``.

    A message passes in a direction if a row allows its group or its name, and no row refuses a whole group that
    contains it.
    """
    role = ROLES.get(str(data.get("role")))
    rates = PolicyRow("rates", _rates(data.get("rate_in"), role and role.rate_in), _rates(data.get("rate_out")))
    return *(row for row in policy.describe() if row.subject not in _NOT_IN_TABLES), rates


def _rates(written: object, by_role: object = None) -> str:
    """The rates of the file, then those of the role for what the file does not name."""
    rates = [part for part in (written, by_role) if isinstance(part, Mapping)]
    texts = [", ".join(f"{name} {rate:g}/s" for name, rate in part.items()) for part in rates]
    return "; else ".join(filter(None, texts)) or "-"
