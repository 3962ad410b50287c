"""Templates of the fleet commands: text with ``{n}`` and ``{name}`` for a member's number and name."""

from __future__ import annotations

import re

_BRACES = re.compile(r"\{n\}|\{name\}|[{}]")


class TemplateError(ValueError):
    """A template contains braces other than ``{n}`` and ``{name}``."""


def fill(template: str, number: int, name: str) -> str:
    """Replace ``{n}`` and ``{name}``. ``str.format`` would give access to attributes.

    Raises:
        TemplateError: the template contains other braces.
    """
    values = {"{n}": str(number), "{name}": name}

    def value(match: re.Match[str]) -> str:
        if match[0] not in values:
            raise TemplateError("the only braces in a template are {n} and {name}")
        return values[match[0]]

    return _BRACES.sub(value, template)
