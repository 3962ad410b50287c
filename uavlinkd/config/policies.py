"""Policies in a configuration: from a section's keys to data that compiles, or every problem in them."""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import Any

from uavlinkd.config.model import PolicyData
from uavlinkd.config.problems import Found, Values
from uavlinkd.config.schema import PolicySection
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings

# A policy's messages repeat a group, a message, a command or a number, so that a person can search for it.
# Any other text may be a secret, or control a terminal, or have a million digits.
_WORD = re.compile(r"[A-Za-z0-9_:. -]{1,32}|[A-Z][A-Z0-9_]{0,55}|command:[A-Z0-9_]{1,55}")
_MOST = 2**63
_HIDDEN = "…"


def data(section: Values) -> PolicyData:
    """The section's policy, as data that cannot change and that messages may repeat."""
    return MappingProxyType(
        {key: _frozen(key, value) for key, value in section.valid.items() if key in PolicySection.model_fields}
    )


def check(section: Values, *, is_local: bool) -> Found:
    """Yield every problem of the section's policy."""
    try:
        read_settings(data(section), is_local=is_local)
    except PolicyError as error:
        for problem in error.problems:
            yield section.at(problem.key), f"{problem.problem}; {problem.remedy}"


def _frozen(key: str, value: Any) -> object:
    if key == "system_ids" and value == ["all"]:
        return "all"  # two spellings of one value
    if isinstance(value, list):
        return tuple(map(_leaf, value))
    if isinstance(value, dict):
        return MappingProxyType({_leaf(key): _leaf(item) for key, item in value.items()})
    return _leaf(value)


def _leaf(value: Any) -> object:
    """One word or number. Any other value becomes a placeholder, which a policy does not know either."""
    if isinstance(value, str):
        return value if _WORD.fullmatch(value) else _HIDDEN
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < _MOST):
        return value
    return _HIDDEN
