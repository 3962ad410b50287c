"""The source files of the package and their imports, found by parsing: no source is executed."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import uavlinkd

PACKAGE = Path(uavlinkd.__file__).parent


def sources(*folders: str) -> Iterator[tuple[str, str]]:
    """The path below the package and the text of every source file; of these folders only, if any are given."""
    for name, text in _all_sources().items():
        if not folders or name.startswith(folders):
            yield name, text


@cache
def _all_sources() -> Mapping[str, str]:
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def parsed(source: str) -> ast.Module:
    """The syntax tree of a source file, made once."""
    return ast.parse(source)


def imports(name: str, source: str) -> set[str]:
    """The full names of all modules that a source imports, also inside functions and for type checking only.

    ``from a import b`` counts as ``a`` and as ``a.b``, because b may be a module.
    """
    return {
        module for base, alias in _statements(name, source) for module in (base, f"{base}.{alias}" if alias else base)
    }


def roots(name: str, source: str) -> set[str]:
    """The top-level packages that a source imports."""
    return {module.split(".")[0] for module in imports(name, source)}


def is_inside(module: str, package: str) -> bool:
    """Whether a module is this package or a part of it."""
    return module == package or module.startswith(package + ".")


@cache
def graph() -> Mapping[str, frozenset[str]]:
    """The modules of the package, each with those that it imports.

    ``from a import b`` leads to ``a.b`` if that is a module, and else to ``a``.
    """
    texts = {_module(name): (name, source) for name, source in sources()}
    edges: dict[str, frozenset[str]] = {}
    for module, (name, source) in texts.items():
        named = {
            f"{base}.{alias}" if f"{base}.{alias}" in texts else base for base, alias in _statements(name, source)
        }
        edges[module] = frozenset(named & texts.keys() - {module})
    return edges


def circle(edges: Mapping[str, frozenset[str]]) -> list[str]:
    """Modules that import each other in a circle; the first is also the last. The list is empty without a circle."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        modules: list[str] = error.args[1]
        return modules
    return []


def _module(name: str) -> str:
    """``protocol/node.py`` is ``uavlinkd.protocol.node``, ``protocol/__init__.py`` is ``uavlinkd.protocol``."""
    return f"uavlinkd/{name}".removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def _statements(name: str, source: str) -> tuple[tuple[str, str], ...]:
    """Each import: ``from a import b`` is ("a", "b"), ``import a`` is ("a", ""). A call counts as ``importlib``."""
    package = ["uavlinkd", *name.split("/")[:-1]]
    found = list[tuple[str, str]]()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            found += ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found += ((base, alias.name) for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("__import__", "importlib.import_module"):
            found.append(("importlib", ""))
    return tuple(found)
