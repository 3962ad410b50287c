"""The reference page ``uavlinkd/config/README.md`` lists every key with the schema's default and range."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from uavlinkd.config import schema
from uavlinkd.mavlink.dialect import GROUPS
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import KEYS, read_settings

PAGE = (Path(__file__).parents[2] / "uavlinkd/config/README.md").read_text()
_ROW = re.compile(r"^\| `(\w+)` \| (.+?) \| (.+?) \| `(.+?)` \| .+ \|$", re.MULTILINE)
SECTIONS: dict[str, type[BaseModel]] = {
    "Top of the file": schema.FileSection,
    "`[link]`": schema.LinkSection,
    "`[[network]]`": schema.NetworkSection,
    "`[[peer]]`": schema.PeerSection,
    "`[[member]]`": schema.MemberSection,
    "`[relay_server]`": schema.RelayServerSection,
    "`[[relay]]`": schema.RelaySection,
    "`[[endpoint]]`": schema.EndpointSection,
    "Policy": schema.PolicySection,
    "`[routing]`": schema.RoutingSection,
    "`[metrics]`": schema.MetricsSection,
    "`[recording]`": schema.RecordingSection,
    "`[log]`": schema.LogSection,
}


def own_keys(model: type[BaseModel]) -> set[str]:
    """The keys that a section adds to those it shares with others, without the names of sections."""
    shared = {key for base in model.__mro__[1:] if issubclass(base, BaseModel) for key in base.__annotations__}
    sections = {title.strip("`[]") for title in SECTIONS} if model is schema.FileSection else set()
    return set(model.model_fields) - shared - sections


def rows(title: str) -> dict[str, tuple[str, str, str]]:
    """Type, default and example of each key that the page lists under a heading."""
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    return {key: (kind, default, example) for key, kind, default, example in _ROW.findall(section)}


def bounds(field: FieldInfo) -> tuple[set[float], set[str]]:
    """The numbers of a key's range, or its choices."""
    if get_origin(field.annotation) is Literal:
        choices = get_args(field.annotation)
        return {choice for choice in choices if not isinstance(choice, str)}, {
            choice for choice in choices if isinstance(choice, str)
        }
    return {getattr(limit, end) for limit in field.metadata for end in ("ge", "le") if hasattr(limit, end)}, set()


def default_of(field: FieldInfo) -> object:
    """A key's default as the page writes it."""
    if field.is_required():
        return "required"
    if isinstance(field.default, list):
        return [suite.name for suite in field.default]
    return "off" if field.default is None else field.default


def documented(default: str) -> object:
    """The default in a row: a TOML value in backticks, or a word."""
    return tomllib.loads(f"value = {default.strip('`')}")["value"] if default.startswith("`") else default


ALL_ROWS = [(title, key, *row) for title in SECTIONS for key, row in rows(title).items()]


@pytest.mark.parametrize("title", SECTIONS)
def test_each_section_lists_its_keys(title: str) -> None:
    """A new key needs a row, and a removed key loses its row."""
    assert set(rows(title)) == own_keys(SECTIONS[title])


def test_every_key_of_the_schema_is_in_one_section() -> None:
    """No section of the schema is left out."""
    models = {
        value for value in vars(schema).values() if isinstance(value, type) and issubclass(value, schema.Section)
    }
    assert models - {schema.Section} == set(SECTIONS.values())


@pytest.mark.parametrize(("title", "key", "kind", "default", "example"), ALL_ROWS)
def test_row_agrees_with_the_schema(title: str, key: str, kind: str, default: str, example: str) -> None:
    """Default, range and choices are the schema's, and the schema accepts the example."""
    if title == "Policy":
        assert key in KEYS
        other = {"system_ids": [1], "role": "observer"}
        read_settings({**other, **tomllib.loads(f"{key} = {example}")}, is_local=False)
        return
    model = SECTIONS[title]
    field = model.model_fields[key]
    assert documented(default) == default_of(field)
    numbers, choices = bounds(field)
    assert numbers <= {float(number) for number in re.findall(r"\d+(?:\.\d+)?", kind)}
    assert choices == set(re.findall(r'"([a-z]+)"', kind))
    value = tomllib.loads(f"value = {example}")["value"]
    model.__pydantic_validator__.validate_assignment(model.model_construct(), key, value)


def test_groups_and_roles_are_listed() -> None:
    """A reader finds every name that a list or `role` takes."""
    words = set(re.findall(r"`([a-z0-9-]+)`", PAGE))
    assert set(GROUPS) | set(ROLES) <= words
