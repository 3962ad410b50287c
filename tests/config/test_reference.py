"""The reference page ``uavlinkd/config/README.md`` lists every key with the schema's default and range."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from pydantic_core import CoreSchema

from uavlinkd.config import schema
from uavlinkd.config.section import Key, Section, read
from uavlinkd.mavlink.dialect import GROUPS
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import KEYS, read_settings

PAGE = (Path(__file__).parents[2] / "uavlinkd/config/README.md").read_text()
_ROW = re.compile(r"^\| `(\w+)` \| (.+?) \| (.+?) \| `(.+?)` \| .+ \|$", re.MULTILINE)
_MODELS = {schema.FileSection, schema.PolicySection, *schema.SINGLE.values(), *schema.REPEATED.values()}
_TITLES = dict(re.findall(r"^## (`\[*(\w+)\]*`|Policy|Top of the file)$", PAGE, re.MULTILINE))


def _model(title: str) -> type[Section]:
    name = {"Policy": "Policy", "Top of the file": "File"}.get(title) or _TITLES[title].title().replace("_", "")
    model: type[Section] = getattr(schema, f"{name}Section")
    return model


def _own_keys(model: type[Section]) -> set[str]:
    """The keys that a section adds to those it shares with others."""
    shared = (base for base in (schema.LinkSection, schema.PolicySection) if model is not base)
    return set(model.keys) - {key for base in shared if issubclass(model, base) for key in base.keys}


def _rows(title: str) -> dict[str, tuple[str, str, str]]:
    """Type, default and example of each key that the page lists under a heading."""
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    return {key: (kind, default, example) for key, kind, default, example in _ROW.findall(section)}


def _limits(kind: CoreSchema) -> set[str]:
    """The numbers of a key's range, or its choices."""
    facts = {**kind, **kind.get("schema", {})}
    limits = (f"{facts[end]:.16g}" for end in ("ge", "le") if end in facts)
    return {*map(str, facts.get("expected", ())), *limits}


def _default(key: Key) -> object:
    """A key's default as the page writes it."""
    if key.is_required:
        return "required"
    if isinstance(key.default, list):
        return [suite.name for suite in key.default]
    return "off" if key.default is None else key.default


ALL_ROWS = [(title, key, *row) for title in _TITLES for key, row in _rows(title).items()]


def test_each_section_lists_its_keys() -> None:
    """A new key needs a row, and a removed key loses its row."""
    assert {_model(title) for title in _TITLES} == _MODELS
    for title in _TITLES:
        assert set(_rows(title)) == _own_keys(_model(title)), title


@pytest.mark.parametrize(("title", "key", "kind", "default", "example"), ALL_ROWS)
def test_row_agrees_with_the_schema(title: str, key: str, kind: str, default: str, example: str) -> None:
    """Default, range and choices are the schema's, and the schema accepts the example."""
    if title == "Policy":
        other = {"system_ids": [1], "role": "observer"}
        read_settings({**other, **tomllib.loads(f"{key} = {example}")}, is_local=False)
        return
    model = _model(title)
    described = model.keys[key]
    written = tomllib.loads(f"value = {default.strip('`')}")["value"] if default.startswith("`") else default
    assert written == _default(described)
    assert _limits(described.kind) <= set(re.findall(r"[\w.]+", kind))
    value = tomllib.loads(f"value = {example}")["value"]
    assert key in read(model, {key: value})[0]


def test_groups_and_roles_are_listed() -> None:
    """A reader finds every name that a policy takes."""
    assert {key for title, key, *_ in ALL_ROWS if title == "Policy"} == set(KEYS)
    assert set(GROUPS) | set(ROLES) <= set(re.findall(r"`([a-z0-9-]+)`", PAGE))
