"""Policies in a configuration: from a section's keys to data that compiles, or every problem in them."""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import Any

from uavlinkd.config.model import PolicyData
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import PolicySection
from uavlinkd.mavlink.policy.compilation import PolicyError, compile_policy

# A policy's messages repeat what was written, so that a person finds it: a group, a message, a command, a number.
# Whatever else stands there may be a secret, or control a terminal, or have a million digits.
_WORD = re.compile(r"[A-Za-z0-9_:. -]{1,32}|[A-Z][A-Z0-9_]{0,55}|command:[A-Z0-9_]{1,55}")
_MOST = 2**63
_HIDDEN = "…"


def data(section: Values) -> PolicyData:
    """The section's policy, as data that cannot change and that messages may repeat."""
    return MappingProxyType(
        {key: _frozen(key, value) for key, value in section.good.items() if key in PolicySection.model_fields}
    )


def check(problems: Problems, section: Values, *, is_local: bool) -> None:
    """Note whatever is wrong in the section's policy."""
    try:
        compile_policy(data(section), is_local=is_local)
    except PolicyError as error:
        for found in error.problems:
            problems.add(section.place.key(found.key), f"{found.problem}; {found.remedy}")


def _frozen(key: str, value: Any) -> object:
    if key == "system_ids" and value == ["all"]:
        return "all"  # two ways to write one thing
    if isinstance(value, list):
        return tuple(map(_leaf, value))
    if isinstance(value, dict):
        return MappingProxyType({_leaf(key): _leaf(each) for key, each in value.items()})
    return _leaf(value)


def _leaf(value: Any) -> object:
    """One word or number. Anything else is none that a policy knows, and so is what stands for it."""
    if isinstance(value, str):
        return value if _WORD.fullmatch(value) else _HIDDEN
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < _MOST):
        return value
    return _HIDDEN
