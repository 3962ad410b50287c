"""What a section of a configuration is made of: kinds of values, keys, and the check of a section by pydantic.

The schemas are those of pydantic's core, written as its plain data. The import of pydantic's models would take half
of the processor time of a start. Each kind is strict by itself: nothing is converted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, NamedTuple

from pydantic_core import CoreSchema, ErrorDetails, SchemaValidator, ValidationError

REQUIRED: Final = object()
"""The default of a key that a section must have."""

BOOLEAN: Final[CoreSchema] = {"type": "bool", "strict": True}
ANYTHING: Final[CoreSchema] = {"type": "any"}


def integer(least: int, most: int) -> CoreSchema:
    return {"type": "int", "ge": least, "le": most, "strict": True}


def number(least: float, most: float) -> CoreSchema:
    return {"type": "float", "ge": least, "le": most, "allow_inf_nan": False, "strict": True}


def choice(*values: str | int) -> CoreSchema:
    return {"type": "literal", "expected": list(values)}


def each(kind: CoreSchema) -> CoreSchema:
    """A list of values of a kind."""
    return {"type": "list", "items_schema": kind, "strict": True}


def parsed(parse: Callable[[Any], object]) -> CoreSchema:
    """What ``parse`` returns for a value. It raises ValueError with the message for the person."""
    return {"type": "function-plain", "function": {"type": "no-info", "function": parse}}


def checked(kind: CoreSchema, check: Callable[[Any], object]) -> CoreSchema:
    """A value of a kind that ``check`` returns. It raises ValueError with the message for the person."""
    return {"type": "function-after", "function": {"type": "no-info", "function": check}, "schema": kind}


class Key(NamedTuple):
    """A key: the kind of its value, its default, and an example as it is written in TOML."""

    kind: CoreSchema
    default: Any
    example: str

    @property
    def is_required(self) -> bool:
        return self.default is REQUIRED


def key(kind: CoreSchema, default: object = REQUIRED, example: str = "") -> Any:
    """A key of a :class:`Section`. Its attribute in an object of the section has the type of the value."""
    return Key(kind, default, example)


class Section:
    """A section. The class has its keys; an object has the value of each key, or its default."""

    keys: ClassVar[dict[str, Key]] = {}

    def __init_subclass__(cls) -> None:
        cls.keys = {name: one for base in reversed(cls.__mro__) for name, one in _own_keys(base)}

    def __init__(self, valid: Mapping[str, Any]) -> None:
        for name, one in self.keys.items():
            setattr(self, name, valid.get(name, one.default))


def _own_keys(section: type) -> list[tuple[str, Key]]:
    return [(name, one) for name, one in vars(section).items() if isinstance(one, Key)]


def read(section: type[Section], table: Mapping[str, Any]) -> tuple[dict[str, Any], list[ErrorDetails]]:
    """The values of the valid keys, and every problem. Unknown keys are problems.

    The checks of several values use the valid ones, so one run reports every problem.
    """
    try:
        return _validator(section).validate_python(table), []
    except ValidationError as error:
        problems = error.errors(include_url=False, include_input=False)  # no message repeats what was written
    wrong = {problem["loc"][0] for problem in problems}
    valid = {name: value for name, value in table.items() if name not in wrong}
    return _validator(section, is_complete=False).validate_python(valid), problems


_validators: dict[tuple[type[Section], bool], SchemaValidator] = {}


def _validator(section: type[Section], *, is_complete: bool = True) -> SchemaValidator:
    """The validator of a section, or of a part of it, which may lack required keys."""
    if (section, is_complete) not in _validators:
        _validators[section, is_complete] = _make_validator(section, is_complete=is_complete)
    return _validators[section, is_complete]


def _make_validator(section: type[Section], *, is_complete: bool) -> SchemaValidator:
    return SchemaValidator(
        {
            "type": "typed-dict",
            "extra_behavior": "forbid",
            "strict": True,
            "fields": {
                name: {
                    "type": "typed-dict-field",
                    "schema": one.kind,
                    "required": one.is_required and is_complete,
                }
                for name, one in section.keys.items()
            },
        }
    )
