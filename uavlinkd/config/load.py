"""Reading a configuration file: TOML, then each section and its key files, then the rules between sections."""

from __future__ import annotations

import os
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from uavlinkd.config import checks, network_rules, pasted_keys, policies, relay_rules, schema
from uavlinkd.config.advice import advice
from uavlinkd.config.keys import CREDENTIALS, KeyFileError, find_secret_file, read_secret_file
from uavlinkd.config.link_settings import link_of
from uavlinkd.config.model import (
    Config,
    ConfigError,
    EndpointConfig,
    Log,
    PeerConfig,
    Problem,
    Recording,
    Routing,
)
from uavlinkd.config.problems import Problems, Sections, Values
from uavlinkd.config.syntax import at, syntax_problem
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
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

    def one(key: str, model: type[schema.Section]) -> Values:
        return problems.read(model, _table(problems, table, key), key)

    def many(key: str, model: type[schema.Section]) -> list[Values]:
        return _sections(problems, table, key, model)

    file = Sections(
        folder=path.absolute().parent,
        top=problems.read(schema.FileSection, table, ""),
        link=one("link", schema.LinkSection),
        log=one("log", schema.LogSection),
        routing=one("routing", schema.RoutingSection),
        metrics=one("metrics", schema.MetricsSection),
        recording=one("recording", schema.RecordingSection),
        relay_server=one("relay_server", schema.RelayServerSection),
        networks=many("network", schema.NetworkSection),
        endpoints=many("endpoint", schema.EndpointSection),
        peers=many("peer", schema.PeerSection),
        members=many("member", schema.MemberSection),
        relays=many("relay", schema.RelaySection),
    )
    for section, key in (
        (file.top, "private_key_file"),
        (file.top, "previous_private_key_file"),
        *((section, "psk_file") for section in file.others),
    ):
        if (secret := _secret(problems, section, key, path, environ)) is not None:
            file.secrets[section.at(key)] = secret
    for place, message in checks.check(file):
        problems.add(place, message)
    problems.raise_any()
    config = _config(path, file)
    warnings = (*pasted_keys.advice(config.private_key.reveal(), file.others), *advice(config))
    return replace(config, warnings=warnings)


def _config(path: Path, file: Sections) -> Config:
    """The configuration in a file without problems, without its warnings."""
    private, public = file.secret(file.top, "private_key_file"), file.own_key()
    assert private is not None  # their absence is a problem
    assert public is not None
    top, recording = file.top, schema.RecordingSection.model_construct(**file.recording.valid)
    folder = _beside(path, recording.folder)
    return Config(
        path=path,
        name=top.valid["name"],
        private_key=private,
        public_key=public,
        listen=tuple(top.get("listen", ())),
        endpoints=tuple(_endpoint(endpoint) for endpoint in file.endpoints),
        peers=tuple(_peer(file, peer) for peer in file.peers),
        routing=Routing(**schema.RoutingSection.model_construct(**file.routing.valid).model_dump()),
        control_socket=_beside(path, top.get("control_socket")),
        metrics=file.metrics.get("listen"),
        recording=Recording(folder, recording.max_files, recording.min_free_bytes) if folder else None,
        log=Log(**schema.LogSection.model_construct(**file.log.valid).model_dump()),
        previous_private_key=file.secret(top, "previous_private_key_file"),
        networks=tuple(network_rules.network_of(network) for network in file.networks),
        relay_server=relay_rules.relay_server_of(file),
        relays=tuple(relay_rules.relay_of(file, relay) for relay in file.relays),
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
    top = problems.read(schema.FileSection, table, "")
    if "control_socket" in top.invalid:
        problems.raise_any()
    return _beside(path, top.get("control_socket"))


def _beside(path: Path, name: str | None) -> Path | None:
    """The path of a file that the configuration names relative to itself."""
    return None if name is None else path.absolute().parent / name


def _endpoint(section: Values) -> EndpointConfig:
    keys = schema.EndpointSection.model_construct(**section.valid)
    return EndpointConfig(keys.name, keys.url, policies.data(section), keys.radio_status, keys.status_text)


def _peer(file: Sections, peer: Values) -> PeerConfig:
    keys = schema.LinkSection.model_construct(**checks.inherited(file.link, peer))
    link, used = link_of(keys), relay_rules.relays_of(peer, file.relays)
    if used or relay_rules.peer_of(peer, (*file.members, *file.relays)):  # they exchange records
        link = replace(link, features=link.features | c.FEATURE_RECORDS)
    psk = file.secret(peer, "psk_file")
    return PeerConfig(
        settings=PeerSettings(peer.valid["name"], peer.valid["public_key"], psk, link),
        addresses=relay_rules.addresses_of(peer, file.relays),
        previous_public_key=peer.get("previous_public_key"),
        relays=used,
        policy=policies.data(peer),
        egress=EgressSettings(keys.budget_bits_s, keys.coalesce_s, keys.max_age_s),
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
    value = table.get(key, {})
    if isinstance(value, dict):
        return value
    problems.add(key, f"must be a section: write [{key}], in single brackets, and its keys below")
    return {}


def _sections(problems: Problems, table: Mapping[str, Any], key: str, model: type[schema.Section]) -> list[Values]:
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
    if (name := section.get(key)) is None:
        return None
    path, is_credential = find_secret_file(name, config.parent, environ)
    place = section.at(key)
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
