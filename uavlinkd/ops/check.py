"""``uavlinkd check``: what is wrong with a configuration, then what the daemon does with it, on one screen.

With ``--verbose`` it shows everything, for a review: the keys of others, and what each policy passes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from uavlinkd.authority.certificates import parse_bulletin
from uavlinkd.authority.enrolment import fingerprint_of, ids_of
from uavlinkd.config.advice import examples
from uavlinkd.config.keys import CREDENTIALS, encode_key, looks_private
from uavlinkd.config.load import load_config
from uavlinkd.config.model import (
    Config,
    ConfigError,
    EndpointConfig,
    FleetConfig,
    NetworkConfig,
    PeerConfig,
)
from uavlinkd.io.url import SerialUrl, StationUrl
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.ops import CHECK_SCHEMA
from uavlinkd.ops.surroundings import look_around
from uavlinkd.system.terminal import FAILED, OK, WRONG, UsageError, add_json, printable

Row = tuple[str, str]
"""What a line is about, and the facts."""
Verdict = dict[str, list[str]]
"""Sentences for a person by their kind, which is a key of ``--json``."""
_LABELS: Final = {"examples": "example", "warnings": "warning", "this_machine": "this machine"}
_OPEN_TO: Final[dict[type, str]] = {SerialUrl: "the wire", StationUrl: "the holder of its key"}
_ROOM: Final = 20
"""Rows of a terminal that the facts fill without ``--verbose``: of 24, with what is above and below them."""


def add_check(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        f"{parser.description} Exit status 1 if something of an example is left in it, 2 if it is wrong."
    )
    parser.set_defaults(command=_check)
    parser.add_argument("--config", metavar="FILE", type=Path, required=True)
    parser.add_argument(
        "--keys", metavar="DIR", type=Path, help="for a service: the folder of its keys, as in LoadCredential="
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--verbose", action="store_true", help="show each key, and what each policy passes")
    add_json(form)


def _check(options: argparse.Namespace) -> int:
    if options.keys is not None and not (options.keys.is_dir() and os.access(options.keys, os.R_OK | os.X_OK)):
        raise UsageError(f"--keys: {options.keys} is not a readable folder")
    environ = os.environ if options.keys is None else {CREDENTIALS: str(options.keys.absolute())}
    config, errors, verdict = None, list[str](), {kind: list[str]() for kind in _LABELS}
    try:
        config = load_config(options.config, environ)
        verdict = judge(config)
    except ConfigError as error:
        if not options.json:
            raise
        errors = list(map(str, error.problems))
    if options.json:
        own = {"name": config and config.name, "public_key": config and encode_key(config.public_key)}
        print(json.dumps({"schema": CHECK_SCHEMA, **own, "errors": errors, **verdict}))
    elif config is not None:
        for line in report(config, verdict, shutil.get_terminal_size().columns, is_verbose=options.verbose):
            print(printable(line))
    return WRONG if errors else FAILED if verdict["examples"] else OK


def judge(config: Config) -> Verdict:
    """What a person should know about a valid configuration."""
    return dict(zip(_LABELS, (list(examples(config)), list(config.warnings), look_around(config)), strict=True))


def report(config: Config, verdict: Verdict, columns: int, *, is_verbose: bool) -> Iterator[str]:
    """The lines, what needs a person first. Each warning and row is one line, for ``grep``."""
    sentences = [f"{_LABELS[kind]}: {text}" for kind, texts in verdict.items() for text in texts]
    yield from sentences or [f"{config.path.name} is ready: no warnings."]
    yield ""
    rows = list(_rows(config, is_verbose))
    width = max(len(subject) for subject, _ in rows)
    lines = [f"{subject:{width}}  {facts}" for subject, facts in rows]
    if is_verbose:
        yield from (*lines, *_policies(config))
        return
    room, shown = _ROOM, 0
    while shown < len(lines) and (room := room - -(-len(lines[shown]) // columns)) >= 0:
        shown += 1
    yield from lines[:shown]
    left = f"{len(lines) - shown} more rows, " if shown < len(lines) else ""
    yield from ("", f"--verbose shows {left}the keys of others, and what each policy passes.")


def _rows(config: Config, is_verbose: bool) -> Iterator[Row]:
    """What is configured, the most important first."""
    key = _key if is_verbose else lambda public_key: ""  # without the keys, most rows fit into a line
    yield "name", config.name
    yield "public key", encode_key(config.public_key)  # whole: the user copies it into the files of the peers
    where = ", ".join(map(str, config.listen))
    nowhere = "nothing: it connects to its peers, from any free port"
    yield "listens on", f"{where} (UDP; answers only senders that know the public key)" if where else nowhere
    for peer in config.peers:
        yield f"peer {peer.name}", _peer(peer, config) + key(peer.settings.public_key)
    yield from map(_endpoint, config.endpoints)
    if config.stations is not None:
        yield "stations", f"come with WireGuard to {config.stations.listen} (UDP), as endpoints"
    if config.relays_frames:
        yield "routing", "also from peer to peer"
    if config.fleet is not None:
        yield from _fleet(config.fleet)
    yield from map(_network, config.networks)
    for relay in config.relays:
        yield f"relay {relay.name}", ", ".join(map(str, relay.addresses)) + key(relay.settings.public_key)
    if (server := config.relay_server) is not None:
        if server.https is not None:
            yield "by TLS", str(server.https.listen)
        for member in server.members:
            yield f"member {member.name}", f"up to {member.bits_s / 1000:,.0f} kbit/s" + key(member.peer.public_key)


def _key(public_key: bytes) -> str:
    """Not shortened: the user compares it with what the other machine printed. A private key is never printed."""
    return f"; public key {'(private?)' if looks_private(public_key) else encode_key(public_key)}"


def _peer(peer: PeerConfig, config: Config) -> str:
    link = peer.settings.link
    where = ", ".join([*map(str, peer.addresses), *(f"relayed via {name}" for name in peer.relays)])
    if not peer.is_called:
        where = f"it connects, to an address of this machine with port {config.listen[0].port}"
    suites = " ".join(suite.name for suite in link.suites)
    mode = "encrypted" if link.confidential else f"{8 * link.tag_bytes}-bit tag"
    return f"{where}; {peer.make_policy()}; {suites}, {mode}{', PSK' if peer.settings.psk else ''}"


def _endpoint(endpoint: EndpointConfig) -> Row:
    exposure = "THE NETWORK" if endpoint.url.is_exposed else _OPEN_TO.get(type(endpoint.url), "this machine")
    rights = endpoint.make_policy() if endpoint.policy else "may send all but SETUP_SIGNING"
    return f"endpoint {endpoint.name}", f"{endpoint.url}, open to {exposure}; {rights}"


def _fleet(fleet: FleetConfig) -> Iterator[Row]:
    own, bulletin, ids = fleet.own.certificate, parse_bulletin(fleet.bulletin), ids_of(fleet.own.certificate)
    assert bulletin is not None  # it was checked
    yield (
        "fleet",
        f"{fingerprint_of(fleet.authority.public)}; bulletin {bulletin.number} in this file, or a newer one",
    )
    systems = f"system id{'s' if '-' in ids else ''} {ids}, " if ids else ""
    yield "certificate", f"{own.name}: {own.role.name.lower()}, {systems}serial {own.serial}"
    for contact in fleet.contacts:
        what = contact.role.name.lower() + (", used as a relay" if contact.relays else "")
        yield f"contact {contact.name}", f"{what}, at {', '.join(map(str, contact.addresses))}"
    for role, limits in fleet.policies.items():
        calls = "this daemon connects to them" if role in fleet.call else "they connect"
        yield (
            f"members: {role.name.lower()}",
            f"{limits.get('role', 'by its lists')}, systems of their certificates; {calls}",
        )


def _network(network: NetworkConfig) -> Row:
    metered = "metered" if network.metered else "not metered"
    budget = f"up to {network.budget_bits_s:,} bits/s" if network.budget_bits_s else "without limit"
    if network.serial is not None:  # with other settings the modem cuts and mixes datagrams
        metered = f"the radio carries {network.air_bits_s:,} bits/s; set a SiK modem to MAVLINK=0, RTSCTS=0 and ECC=0"
    return f"network {network.name}", f"{network.exit}, sends {budget}; {metered}"


# Policies, for a review.


def _policies(config: Config) -> Iterator[str]:
    """Each policy once, with the names of its peers and endpoints."""
    of_file: list[PeerConfig | EndpointConfig] = [*config.peers, *config.endpoints]
    policies = [(one.name, one.make_policy()) for one in of_file if one.policy]
    for role, limits in config.fleet.policies.items() if config.fleet else ():
        policies.append((f"members: {role.name.lower()}", Policy({**limits, "system_ids": dialect.ALL})))
    names_of: dict[tuple[PolicyRow, ...], list[str]] = {}
    for name, policy in policies:
        names_of.setdefault(tuple(policy.describe()), []).append(name)
    for rows, names in names_of.items():
        yield from ("", f"Policy of {', '.join(names)}")
        yield from (f"{row.subject}: from it {row.incoming}; to it {row.outgoing}" for row in rows)
