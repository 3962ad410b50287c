"""Templates of the fleet commands: text in which ``{n}`` and ``{name}`` stand for a member's number and name."""

from __future__ import annotations

import re

_BRACES = re.compile(r"\{n\}|\{name\}|[{}]")


class TemplateError(ValueError):
    """A template has something other than ``{n}`` and ``{name}`` in braces, or an unpaired brace."""


def fill(template: str, number: int, name: str) -> str:
    """Put a number and a name into a template. ``str.format`` is not used: it gives access to attributes.

    Raises:
        TemplateError: see there.
    """
    values = {"{n}": str(number), "{name}": name}

    def value(match: re.Match[str]) -> str:
        if match[0] not in values:
            raise TemplateError("the only braces in a template are {n} and {name}")
        return values[match[0]]

    return _BRACES.sub(value, template)
