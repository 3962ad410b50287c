"""The output of ``uavlinkd check``: identity, peers, the ports that the network reaches, and the policies."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Final

from uavlinkd.authority.certificates import parse_bulletin
from uavlinkd.authority.enrolment import fingerprint_of, ids_of
from uavlinkd.config.advice import exposure
from uavlinkd.config.keys import encode_key, looks_private
from uavlinkd.config.model import Config, EndpointConfig, FleetConfig, PeerConfig, PolicyData, RelayConfig
from uavlinkd.config.network_rules import used_networks
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.system.terminal import printable


def print_topology(config: Config, lacks: Sequence[str] = (), columns: int | None = None) -> None:
    """Print the topology as plain text, the warnings first. ``lacks``: what this machine does not have now.

    Users compare and copy keys and URLs, so each row and warning is one line; only policies are folded.
    """
    columns = columns or shutil.get_terminal_size().columns
    for line in (*_verdict(config.warnings, lacks), *_facts(config), *_policies(config, columns)):
        print(printable(line))


def _verdict(warnings: Sequence[str], lacks: Sequence[str]) -> Iterator[str]:
    """All warnings, or a line that says that there is none."""
    yield from (f"warning: {warning}" for warning in warnings)
    yield from (f"this machine: {lack}" for lack in lacks)
    yield from () if warnings or lacks else ("No warnings.",)
    yield ""


def _facts(config: Config) -> Iterator[str]:
    """The tables of what is configured, the most important first."""
    yield from _table((), _identity(config))
    if config.fleet is not None:
        yield from _titled("Fleet", _table((), _fleet(config.fleet)))
    if config.networks:
        yield from _titled("Networks", _table((), _networks(config)))
    if config.peers:
        columns = ("name", "address", "suites", "mode, at least", "PSK")
        yield from _titled("Peers", _table(columns, map(_peer, config.peers)))
        if not all(peer.is_called for peer in config.peers):
            port = config.listen[0].port
            yield f"(it connects): the peer's file needs an address of this machine, with port {port}"
        yield ""
        keys = ((peer.name, _whole(peer.settings.public_key)) for peer in config.peers)
        yield from _table(("name", "public key"), keys)
    if config.relays:
        relays = _table(("name", "public key", "address", "PSK"), map(_relay, config.relays))
        yield from _titled("Relays", relays)
    if config.endpoints:
        columns = ("name", "URL", "RADIO_STATUS", "STATUSTEXT", "plain MAVLink is open to")
        yield from _titled("Local endpoints", _table(columns, map(_endpoint, config.endpoints)))
    if config.relay_server is not None:
        columns = ("name", "public key", "PSK", "members", "kbit/s")
        members = _table(columns, map(_member, config.relay_server.members))
        yield from _titled("Members of this relay, and their limits", members)


def _titled(title: str, lines: Iterable[str]) -> Iterator[str]:
    yield from ("", title)
    yield from lines


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A line for each row, with columns of equal width."""
    table = [*([titles] if titles else []), *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]


def _yes(condition: object) -> str:
    return "yes" if condition else "no"


def _whole(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed. A private key is never printed."""
    return "(private?)" if looks_private(public_key) else encode_key(public_key)


def _identity(config: Config) -> Iterator[tuple[str, str]]:
    yield "name", config.name
    yield "public key", encode_key(config.public_key)  # whole: the user copies it into the files of the peers
    yield "listens on", _listening(config)
    if not config.is_only_relay:
        others = ", and from peer to peer" if config.relays_frames else " only"
        yield "routing", f"between peers and endpoints{others}"
    if config.relay_server is not None and (https := config.relay_server.https) is not None:
        how = "" if https.certificate else " (without TLS, for a web server on this machine)"
        yield "by TLS", f"{https.listen}{how}"


def _fleet(fleet: FleetConfig) -> Iterator[tuple[str, str]]:
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
        yield network.name, f"{network.exit}{text}; used for {', '.join(used) or 'no address of a peer'}"


def _peer(peer: PeerConfig) -> tuple[str, ...]:
    link = peer.settings.link
    mode = "encrypted"
    if not link.confidential:
        mode = f"authentic, {8 * link.tag_bytes}-bit tag"
    return (
        peer.name,
        ", ".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)]) or "(it connects)",
        " ".join(suite.name for suite in link.suites),
        mode,
        _yes(peer.settings.psk),
    )


def _relay(relay: RelayConfig) -> tuple[str, ...]:
    addresses = ", ".join(map(str, relay.addresses))
    return relay.name, _whole(relay.settings.public_key), addresses, _yes(relay.settings.psk)


def _member(member: MemberSettings) -> tuple[str, ...]:
    limits = f"{member.most_peers:,}", f"{member.limits.bits_s / 1000:,.0f}"
    return member.name, _whole(member.peer.public_key), _yes(member.peer.psk), *limits


def _endpoint(endpoint: EndpointConfig) -> tuple[str, ...]:
    is_told = _yes(endpoint.radio_status), _yes(endpoint.status_text)
    return endpoint.name, str(endpoint.url), *is_told, exposure(endpoint)


# Policies, for a review.

_NOT_IN_TABLES: Final = frozenset({"role", "may speak as", "urgent"})
"""Rows in the summary; and a group that sets only the order: each of its messages is in another group."""
_WHOLE: Final = (("both directions", ("all", "passes")), ("no direction", ("none", "never", "refused")))

_Rows = tuple[PolicyRow, ...]


def _policies(config: Config, columns: int) -> Iterator[str]:
    """A line for each peer and endpoint; then each policy once, with the names of its peers and endpoints."""
    senders = [("peer", peer.name, peer.policy, peer.make_policy()) for peer in config.peers]
    senders += [("endpoint", endpoint.name, endpoint.policy, endpoint.make_policy()) for endpoint in config.endpoints]
    for member, limits in config.fleet.policies.items() if config.fleet else ():
        of_role = {**limits, "system_ids": dialect.ALL}
        senders.append(("members", member.name.lower(), of_role, Policy(of_role)))
    if not senders:
        return
    summary: list[tuple[str, ...]] = []
    names_of: dict[_Rows, list[str]] = {}
    for kind, name, data, policy in senders:
        if not data:
            summary.append((kind, name, "may send everything except SETUP_SIGNING", "any"))
            continue
        incoming = {row.subject: row.incoming for row in policy.describe()}
        role = incoming["role"]
        if kind == "peer" and role == dialect.ALL:
            role = "all: everything except SETUP_SIGNING"
        systems = "of its certificate" if kind == "members" else incoming["may speak as"]
        summary.append((kind, name, role, systems))
        names_of.setdefault(table_rows(policy, data), []).append(f"members: {name}" if kind == "members" else name)
    yield from _titled("Roles", _table(("", "name", "role", "system ids"), summary))
    for rows, names in names_of.items():
        yield from ("", f"Policy of {', '.join(names)}")
        for text in _policy(rows):
            yield from wrap(text, columns, subsequent_indent="    ", break_on_hyphens=False)


def _policy(rows: _Rows) -> Iterator[str]:
    """The groups that pass in both directions, those that pass in none, and the rest."""
    alike: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        alike.setdefault((row.incoming, row.outgoing), []).append(row.subject)
    for title, verdicts in _WHOLE:
        if subjects := [subject for verdict in verdicts for subject in alike.pop((verdict, verdict), ())]:
            yield f"{title}: {', '.join(subjects)}"
    alike.pop(("-", "-"), None)
    for (incoming, outgoing), subjects in alike.items():
        yield f"{', '.join(subjects)}: from it {incoming}; to it {outgoing}"


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
