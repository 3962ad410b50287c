"""Problems of a configuration file, for the person who wrote it.

A message names the file, the key, the problem and what to write instead. It never repeats a value: a value in
the wrong place may be a secret.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.schema import (
    EndpointSection,
    FileSection,
    LinkSection,
    LogSection,
    MemberSection,
    MetricsSection,
    NetworkSection,
    PeerSection,
    PolicySection,
    RecordingSection,
    RelaySection,
    RelayServerSection,
    RoutingSection,
    Section,
)


class SectionName(NamedTuple):
    """A section of the file: ``peer[1]``, and the name that it has there."""

    section: str
    name: str = ""

    def key(self, key: str) -> str:
        """``peer[1].public_key (drone1)``."""
        path = ".".join(part for part in (self.section, key) if part)
        return f"{path} ({self.name})" if self.name else path


class Values(NamedTuple):
    """The valid values of a section by key, and the keys whose values are invalid."""

    place: SectionName
    valid: dict[str, Any]
    invalid: frozenset[str]


class Problems:
    """The problems of one file, in the order in which they are found."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._found: list[Problem] = []

    def add(self, key: str, message: str) -> None:
        """Add one problem."""
        self._found.append(Problem(self._file, key, message))

    def raise_any(self) -> None:
        """Raise ConfigError if there is a problem."""
        if self._found:
            raise ConfigError(tuple(self._found))

    def read(self, model: type[Section], table: Mapping[str, Any], section: str) -> Values:
        """Check one section by its model and add its problems."""
        valid: dict[str, Any] = {}
        invalid: set[str] = set()
        try:
            model.model_validate(table, context=valid)
        except ValidationError as error:
            place = SectionName(section, valid.get("name", "") if section else "")
            for details in error.errors(include_url=False, include_input=False):
                invalid.add(str(details["loc"][0]))
                self.add(place.key(_path(details["loc"])), _message(details, model))
        # The context has no list with an invalid item, but it may have a value that a later check refused.
        return Values(
            SectionName(section, valid.get("name", "") if section else ""),
            {key: value for key, value in valid.items() if key not in invalid},
            frozenset(invalid),
        )


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,32}")


def _path(location: tuple[int | str, ...]) -> str:
    """``suites[0]``. Only a plain word is repeated: another key may be a secret, or control a terminal."""
    parts = [
        f"[{part}]" if isinstance(part, int) else part if _BARE_KEY.fullmatch(part) else "…" for part in location
    ]
    return "".join(parts)


def _message(details: ErrorDetails, model: type[Section]) -> str:
    """The problem and its remedy, for each kind of error that the schema can raise."""
    key = str(details["loc"][0])
    context = details.get("ctx", {})
    match details["type"]:
        case "missing":
            return f"is missing: write {key} = {_example(model, key)}"
        case "extra_forbidden":
            return unknown_key(key, model)
        case "value_error":
            return str(context["error"])
        case "bool_type":
            # A person who writes the key wants another value than the default.
            other = str(not model.model_fields[key].default).lower()
            return f"must be true or false, without quotes: write {key} = {other}"
        case "int_type":
            return f"must be a whole number, without quotes: write {key} = {_example(model, key)}"
        case "finite_number":
            return f"must be a finite number: write {key} = {_example(model, key)}"
        case "float_type":
            return f"must be a number, without quotes: write {key} = {_example(model, key)}"
        case "greater_than_equal":
            return f"is too small: write {_number(context['ge'])} or more"
        case "less_than_equal":
            return f"is too large: write {_number(context['le'])} or less"
        case "literal_error":
            return f"must be {context['expected']}"
        case "list_type":
            return f"must be a list: write {key} = {_example(model, key)}"
        case _:  # a kind of error that the schema does not raise today
            return f"cannot be used: write {key} = {_example(model, key)}"


def _number(limit: object) -> str:
    """As text for the file: a whole number has no decimal point."""
    return f"{limit:g}" if isinstance(limit, float) else str(limit)


def _example(model: type[Section], key: str) -> str:
    """A value as it is written in TOML: the schema's example, else the default."""
    field = model.model_fields[key]
    if field.examples:
        return str(field.examples[0])
    return f"{field.default:g}"


# The policy's keys are checked by the policy itself, so the schema has no examples of them.
_EXAMPLES = {
    "role": '"swarm-member"',
    "system_ids": "[2]",
    **dict.fromkeys(("allow_in", "deny_in", "allow_out", "deny_out"), '["heartbeat", "telemetry"]'),
    **dict.fromkeys(("rate_in", "rate_out"), "{ ATTITUDE = 10 }"),
    **dict.fromkeys(("mavlink1", "ground_station"), "false"),
}


def example_of(key: str) -> str | None:
    """A value of a key as it is written in TOML; None if no section has the key."""
    if key in _EXAMPLES:
        return _EXAMPLES[key]
    for model in _SECTIONS.values():
        if key in model.model_fields and (field := model.model_fields[key]).annotation is not Any:
            if field.examples:
                return str(field.examples[0])
            if isinstance(field.default, bool):
                return str(field.default).lower()
            return f'"{field.default}"' if isinstance(field.default, str) else f"{field.default:g}"
    return None


_SECTIONS: dict[str, type[Section]] = {
    "at the top, before the first [section]": FileSection,
    "in [link] or in a [[peer]]": LinkSection,
    "in a [[peer]] or an [[endpoint]]": PolicySection,
    "in a [[peer]]": PeerSection,
    "in a [[relay]]": RelaySection,
    "in a [[network]]": NetworkSection,
    "in an [[endpoint]]": EndpointSection,
    "in a [[member]]": MemberSection,
    "in [relay_server]": RelayServerSection,
    "in [log]": LogSection,
    "in [routing]": RoutingSection,
    "in [metrics]": MetricsSection,
    "in [recording]": RecordingSection,
}

# Names that WireGuard, mavlink-router and common usage have for these keys.
_OTHERS_CALL_IT = {
    "private_key": "private_key_file, the name of a file that holds the key: this file never contains a key",
    "key": "private_key_file, or public_key in a [[peer]]",
    "psk": "psk_file, the name of a file that holds the key: this file never contains a key",
    "preshared_key": "psk_file, the name of a file that holds the key: this file never contains a key",
    "listen_port": 'listen, with an address: listen = ["0.0.0.0:5790"]',
    "port": 'listen, with an address: listen = ["0.0.0.0:5790"]',
    "persistent_keepalive": "keepalive_s, in seconds",
    "mtu": "max_envelope_bytes, the size of the UDP payload",
    "encrypt": "confidential = true",
    "encryption": "confidential = true",
    "suite": 'suites, a list: suites = ["x25519"]',
    "udp_endpoint": "[[endpoint]], with name and url",
    "uart_endpoint": "[[endpoint]], with name and url",
}
_FILTERS = {
    "block_msg_id_in": "deny_in, a list of messages by name",
    "block_msg_id_out": "deny_out, a list of messages by name",
    "allow_msg_id_in": "allow_in, a list of messages by name",
    "allow_msg_id_out": "allow_out, a list of messages by name",
    "allow_src_sys_in": "system_ids, a list",
}
_UDP, _SERIAL = 'url = "udpin:127.0.0.1:14550"', 'url = "serial:/dev/ttyACM0:57600"'
_OTHERS_CALL_IT_IN: dict[type[Section], dict[str, str]] = {
    FileSection: {
        "log_level": '[log] at the end of the file, and below it level = "info"',
        "interface": "name, private_key_file and listen here, or interface in a [[network]]",
    },
    PeerSection: {
        "address": 'addresses, a list: addresses = ["10.13.0.2:5790"]',
        "interface": 'addresses = [{ address = "10.13.0.2:5790", network = "mesh" }], and a [[network]] "mesh" with'
        " this interface",
        "endpoint": 'addresses, a list: addresses = ["10.13.0.2:5790"]',
        "allowed_ips": "role and system_ids: they say what the peer may do",
        **_FILTERS,
    },
    RelaySection: dict.fromkeys(("address", "endpoint"), 'addresses, a list: addresses = ["relay.example.org:5790"]'),
    EndpointSection: {
        **dict.fromkeys(("address", "port", "server"), _UDP),
        "mode": f"{_UDP}, or udpout",
        **dict.fromkeys(("device", "baud", "serial"), _SERIAL),
        **_FILTERS,
    },
}


def unknown_key(key: str, model: type[Section]) -> str:
    """What to write for a key that the section does not have."""
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[ -]", "_", key).lower()
    here = _OTHERS_CALL_IT_IN.get(model, {})
    if plain in here:
        return f"is not known here: write {here[plain]}"
    if plain in _OTHERS_CALL_IT:
        return f"is not known: write {_OTHERS_CALL_IT[plain]}"
    for where, other in _SECTIONS.items():
        if key in other.model_fields and key not in model.model_fields:
            return f"does not belong here: write it {where}"
    known = list(model.model_fields)
    if close := get_close_matches(plain, known, n=1, cutoff=0.7):
        written = (
            f"[[{close[0]}]]"
            if model is FileSection and close[0] in ("peer", "endpoint", "network", "member", "relay")
            else close[0]
        )
        return f"is not known: did you mean {written}?"
    return f"is not known here: the keys are {', '.join(known)}"
