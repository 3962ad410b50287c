"""Reading a configuration file: TOML, then each section and its key files, then the rules between sections."""

from __future__ import annotations

import os
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from uavlinkd.config import checks, network_rules, pasted_keys, policies, relay_rules, used_relays
from uavlinkd.config.advice import advice
from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.keys import CREDENTIALS, KeyFileError, find_secret_file, read_secret_file
from uavlinkd.config.link_settings import link_of
from uavlinkd.config.model import Config, EndpointConfig, Log, PeerConfig, Recording, Routing
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import (
    EndpointSection,
    FileSection,
    LinkSection,
    LogSection,
    MemberSection,
    MetricsSection,
    NetworkSection,
    PeerSection,
    RecordingSection,
    RelaySection,
    RelayServerSection,
    RoutingSection,
    Section,
)
from uavlinkd.config.syntax import at, syntax_problem
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret, x25519_public_key
from uavlinkd.core.settings import PeerSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.system.threads import Threads

_MAX_FILE_BYTES = 1 << 20
_THREAD = Threads(1, "configuration")


def load_config(path: Path, environ: Mapping[str, str]) -> Config:
    """The configuration in a file. Of ``environ``, only ``CREDENTIALS_DIRECTORY`` is used.

    Raises:
        ConfigError: with every problem of the file. An invalid value never becomes a default.
    """
    table = _read_toml(path)
    problems = Problems(str(path))
    top = problems.read(FileSection, table, "")
    link = problems.read(LinkSection, _table(problems, table, "link"), "link")
    log = problems.read(LogSection, _table(problems, table, "log"), "log")
    routing = problems.read(RoutingSection, _table(problems, table, "routing"), "routing")
    metrics = problems.read(MetricsSection, _table(problems, table, "metrics"), "metrics")
    recording = problems.read(RecordingSection, _table(problems, table, "recording"), "recording")
    networks = _sections(problems, table, "network", NetworkSection)
    endpoints = _sections(problems, table, "endpoint", EndpointSection)
    peers = _sections(problems, table, "peer", PeerSection)
    members = _sections(problems, table, "member", MemberSection)
    server = problems.read(RelayServerSection, _table(problems, table, "relay_server"), "relay_server")
    relays = _sections(problems, table, "relay", RelaySection)

    private = _secret(problems, top, "private_key_file", path, environ)
    previous = _secret(problems, top, "previous_private_key_file", path, environ)
    psks = [_secret(problems, peer, "psk_file", path, environ) for peer in peers]
    member_psks = [_secret(problems, member, "psk_file", path, environ) for member in members]
    relay_psks = [_secret(problems, relay, "psk_file", path, environ) for relay in relays]
    public = _public(private) if private else None

    checks.names(problems, endpoints)
    checks.names(problems, peers)
    checks.public_keys(problems, peers, public, private.reveal() if private else None)
    relay_rules.members(problems, members, peers, public, private.reveal() if private else None)
    relay_rules.relay_server(problems, top, server, members, has_frames=bool(peers or endpoints))
    pasted_keys.check(
        problems,
        [*peers, *members, *relays],
        private.reveal() if private else None,
        [psk.reveal() if psk else None for psk in (*psks, *member_psks, *relay_psks)],
        path.absolute().parent,
    )
    previous_public = _public(previous) if previous else None
    checks.previous_keys(problems, top, [*peers, *members, *relays], public, previous_public)
    checks.reachability(problems, top, peers, [peer for peer in peers if used_relays.needs_no_address(peer, relays)])
    checks.reachability(problems, top, relays, relays)
    used_relays.relays(problems, relays, peers, members, public)
    network_rules.networks(problems, top, networks, [*peers, *relays], endpoints)
    checks.endpoints(problems, top, endpoints)
    checks.metrics(problems, metrics, endpoints)
    checks.recording(problems, recording, peers)
    checks.timers(problems, link)
    for endpoint in endpoints:
        policies.check(problems, endpoint, is_local=True)
    for peer in peers:
        checks.timers(problems, peer, link)
        policies.check(problems, peer, is_local=False)
    for section, psk in zip((*peers, *members, *relays), (*psks, *member_psks, *relay_psks), strict=True):
        if psk is not None and psk == private:
            problems.add(
                section.place.key("psk_file"),
                "holds this daemon's private key, which must stay secret: make a PSK with `uavlinkd psk`",
            )
    problems.raise_any()

    assert private is not None  # its absence is a problem, raised above
    listen = tuple(top.valid.get("listen", ()))
    network_configs = tuple(map(network_rules.network_of, networks))
    own_listen = () if any(network.serial is None for network in network_configs) else listen
    endpoint_configs = tuple(map(_endpoint, endpoints))
    relay_config = relay_rules.relay_server_of(server, members, member_psks, link)
    peer_configs = tuple(_peer(peer, psk, link, members, relays) for peer, psk in zip(peers, psks, strict=True))
    relay_configs = tuple(
        used_relays.relay_of(relay, peers, psk, link) for relay, psk in zip(relays, relay_psks, strict=True)
    )
    routing_config = Routing(**RoutingSection.model_construct(**routing.valid).model_dump())
    return Config(
        path=path,
        name=top.valid["name"],
        private_key=private,
        public_key=_public(private),
        listen=listen,
        endpoints=endpoint_configs,
        peers=peer_configs,
        routing=routing_config,
        control_socket=_beside(path, top.valid.get("control_socket")),
        metrics=metrics.valid.get("listen"),
        recording=_recording(path, recording),
        log=Log(**LogSection.model_construct(**log.valid).model_dump()),
        previous_private_key=previous,
        key_grace_s=FileSection.model_construct(**top.valid).key_grace_s,
        networks=network_configs,
        relay_server=relay_config,
        relays=relay_configs,
        warnings=(
            *pasted_keys.advice(
                private.reveal(),
                (
                    (what, section.valid["name"], section.valid["public_key"])
                    for what, sections in (("peer", peers), ("member", members), ("relay", relays))
                    for section in sections
                ),
            ),
            *advice(
                own_listen,
                endpoint_configs,
                peer_configs,
                routing_config,
                metrics.valid.get("listen"),
                is_relay=relay_config is not None,
            ),
            *(() if relay_config is None else relay_rules.advice(relay_config, own_listen)),
            *used_relays.advice(relay_configs, peer_configs),
        ),
    )


async def load_in_thread(path: Path, environ: Mapping[str, str]) -> Config:
    """Run :func:`load_config` in a worker thread: a slow disk or a named pipe must not stop the event loop.

    If the task is cancelled, the thread ends later and its result is discarded.

    Raises:
        ConfigError: every problem of the file, or no thread can be started now.
    """
    try:
        return await _THREAD.run(load_config, path, environ)
    except OSError as error:
        raise ConfigError((Problem(str(path), "", f"cannot be read now: {error.strerror}: try again"),)) from None


def load_control_socket(path: Path) -> Path | None:
    """The control socket of a configuration, if it has one. The other keys may be invalid or missing.

    Raises:
        ConfigError: the file cannot be read, or its value for the socket is invalid.
    """
    table = _read_toml(path)
    problems = Problems(str(path))
    top = problems.read(FileSection, table, "")
    if "control_socket" in top.invalid:
        problems.raise_any()
    return _beside(path, top.valid.get("control_socket"))


def _public(private: Secret) -> bytes:
    return x25519_public_key(private.reveal())


def _beside(path: Path, name: str | None) -> Path | None:
    """The path of a file that the configuration names relative to itself."""
    return None if name is None else path.absolute().parent / name


def _recording(path: Path, section: Values) -> Recording | None:
    keys = RecordingSection.model_construct(**section.valid)
    folder = _beside(path, keys.folder)
    if folder is None:
        return None
    return Recording(folder, keys.max_file_bytes, keys.max_files, keys.min_free_bytes)


def _endpoint(section: Values) -> EndpointConfig:
    keys = EndpointSection.model_construct(**section.valid)
    return EndpointConfig(
        name=keys.name,
        url=keys.url,
        policy=policies.data(section),
        max_age_s=keys.max_age_s,
        radio_status=keys.radio_status,
        status_text=keys.status_text,
    )


def _peer(
    peer: Values, psk: Secret | None, link: Values, members: Sequence[Values], relays: Sequence[Values]
) -> PeerConfig:
    keys = LinkSection.model_construct(**checks.inherited(link, peer))
    link_settings, used = link_of(keys), used_relays.relays_of(peer, relays)
    served = {section.valid["public_key"] for section in (*members, *relays)}
    if used or peer.valid["public_key"] in served:  # they exchange records
        link_settings = replace(link_settings, features=link_settings.features | c.FEATURE_RECORDS)
    return PeerConfig(
        settings=PeerSettings(
            name=peer.valid["name"], public_key=peer.valid["public_key"], psk=psk, link=link_settings
        ),
        addresses=used_relays.addresses_of(peer, relays),
        previous_public_key=peer.valid.get("previous_public_key"),
        relays=used,
        policy=policies.data(peer),
        egress=EgressSettings(
            budget_bits_s=keys.budget_bits_s,
            coalesce_s=keys.coalesce_s,
            max_age_s=keys.max_age_s,
        ),
    )


def _read_toml(path: Path) -> dict[str, Any]:
    """The file's tables.

    Raises:
        ConfigError: the file cannot be read, or is not valid TOML.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise ConfigError((Problem(str(path), "", f"cannot be read: {reason}"),)) from None
    if len(content) > _MAX_FILE_BYTES:
        raise ConfigError((Problem(str(path), "", "is over a megabyte: name a configuration file"),))
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise ConfigError((at(path, line, column, "is not text in UTF-8: save the file as UTF-8"),)) from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError((syntax_problem(path, text, error),)) from None


def _table(problems: Problems, table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A section that a file has at most once."""
    value = table.get(key, {})
    if isinstance(value, dict):
        return value
    problems.add(key, f"must be a section: write [{key}], in single brackets, and its keys below")
    return {}


def _sections(problems: Problems, table: Mapping[str, Any], key: str, model: type[Section]) -> list[Values]:
    """The sections of a kind that a file may have many times."""
    value = table.get(key, [])
    sections = value if isinstance(value, list) else [value]
    if key == "relay" and isinstance(value, bool):
        problems.add(key, "does not belong here: write it in [routing], or [[relay]] for a relay")
    elif sections is not value or not all(isinstance(section, dict) for section in sections):
        problems.add(key, f"must be a list of sections: write [[{key}]], in double brackets, for each")
    return [
        problems.read(model, section, f"{key}[{number}]")
        for number, section in enumerate(sections)
        if isinstance(section, dict)
    ]


def _secret(problems: Problems, section: Values, key: str, config: Path, environ: Mapping[str, str]) -> Secret | None:
    """The content of the key file that a section names, if it names one."""
    name = section.valid.get(key)
    if name is None:
        return None
    path, is_credential = find_secret_file(name, config.parent, environ)
    place = section.place.key(key)
    is_service = bool(environ.get(CREDENTIALS))
    if not os.path.lexists(path):
        credential = " and no systemd credential of that name" if is_service else ""
        remedy = _FOR_A_SERVICE if is_service else _how_to_get(key, path, config)
        problems.add(place, f"there is no file {path}{credential}: {remedy}")
        return None
    try:
        return read_secret_file(path, credential=is_credential)
    except KeyFileError as error:
        problems.add(place, f"{error}; {_FOR_A_SERVICE}" if is_service and not is_credential else str(error))
        return None


_FOR_A_SERVICE = (
    "put a service's keys into the folder that LoadCredential= names in its unit, owned by root and with mode 0600; "
    "the service reads them at its next start"
)


def _how_to_get(key: str, path: Path, config: Path) -> str:
    """The remedy for a key file that is not there."""
    where = shlex.quote(str(path))
    if key == "previous_private_key_file":
        return "it holds the previous key; if that is lost, delete this line"
    if key == "psk_file":
        remedy = f"copy it from the peer, or make it on one of the two with `uavlinkd psk --out {where}`"
    else:
        remedy = f"make it with `uavlinkd keygen --out {where}`"
    # Folders where the systemd units look for key files that the configuration names without a folder.
    for folder in (config.parent / "keys", config.with_suffix("")):
        if folder.is_dir():
            option = f"--keys {shlex.quote(str(folder))}"
            return f"{remedy}; for a service's configuration, add `{option}` to `uavlinkd check`"
    return remedy
