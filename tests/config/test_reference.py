"""The reference page ``uavlinkd/config/README.md`` lists every key with the schema's default and range."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from uavlinkd.config.schema import LINK, POLICY, SECTIONS, TOP
from uavlinkd.config.section import REQUIRED, Choice, Key, Keys, Number, read
from uavlinkd.mavlink.dialect import GROUPS
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import read_settings
from uavlinkd.system.addresses import Address

PAGE = (Path(__file__).parents[2] / "uavlinkd/config/README.md").read_text()
_ROW = re.compile(r"^\| `(\w+)` \| (.+?) \| (.+?) \| `(.+?)` \| .+ \|$", re.MULTILINE)
_TITLES = dict(re.findall(r"^## (`\[*(\w+)\]*`|Policy|Top of the file)$", PAGE, re.MULTILINE))


def _keys(title: str) -> Keys:
    """The keys that the page lists under a heading: those that the section does not share with others."""
    if shared := {"Policy": POLICY, "Top of the file": TOP, "`[link]`": LINK}.get(title):
        return shared
    keys = SECTIONS[_TITLES[title]]
    others = [name for group in (POLICY, LINK) if group is not keys and group.keys() <= keys.keys() for name in group]
    return {name: key for name, key in keys.items() if name not in others}


def _rows(title: str) -> dict[str, tuple[str, str, str]]:
    """Type, default and example of each key that the page lists under a heading."""
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    return {key: (kind, default, example) for key, kind, default, example in _ROW.findall(section)}


def _limits(key: Key) -> set[str]:
    """The numbers of a key's range, or its choices."""
    if isinstance(key.kind, Number):
        return {f"{limit:.12g}" for limit in (key.kind.least, key.kind.most)}
    return set(map(str, key.kind.values)) if isinstance(key.kind, Choice) else set()


def _default(key: Key) -> object:
    """A key's default as the page writes it."""
    if key.default is REQUIRED:
        return "required"
    return "off" if key.default is None else str(key.default) if isinstance(key.default, Address) else key.default


ALL_ROWS = [(title, key, *row) for title in _TITLES for key, row in _rows(title).items()]


def test_each_section_lists_its_keys() -> None:
    """A new key needs a row, and a removed key loses its row."""
    assert set(_TITLES.values()) - {""} == set(SECTIONS)
    for title in _TITLES:
        assert set(_rows(title)) == set(_keys(title)), title


@pytest.mark.parametrize(("title", "key", "kind", "default", "example"), ALL_ROWS)
def test_row_agrees_with_the_schema(title: str, key: str, kind: str, default: str, example: str) -> None:
    """Default, range and choices are the schema's, and the schema accepts the example."""
    if title == "Policy":
        other = {"system_ids": [1], "role": "observer"}
        read_settings({**other, **tomllib.loads(f"{key} = {example}")}, is_local=False)
        return
    described = _keys(title)[key]
    written = tomllib.loads(f"value = {default.strip('`')}")["value"] if default.startswith("`") else default
    assert written == _default(described)
    assert _limits(described) <= set(re.findall(r"[\w.]+", kind))
    value = tomllib.loads(f"value = {example}")["value"]
    assert read({key: described}, {key: value})[1] == []


def test_groups_and_roles_are_listed() -> None:
    """A reader finds every name that a policy takes."""
    assert set(GROUPS) | set(ROLES) <= set(re.findall(r"`([a-z0-9-]+)`", PAGE))
