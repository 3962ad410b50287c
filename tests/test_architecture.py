"""The walls between the rooms, by walking every import, and that a hole in one of them would be seen."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import uavlinkd
from uavlinkd import core

PACKAGE = Path(uavlinkd.__file__).parent
IMPURE = {
    *("asyncio", "concurrent", "multiprocessing", "select", "selectors", "signal", "socket", "ssl", "threading"),
    *("datetime", "time", "uuid", "random", "secrets"),
    *("io", "logging", "os", "pathlib", "structlog", "subprocess", "sys", "tempfile"),
}
"""Whatever leads to a socket, a clock, a log, a file, another thread or chance."""
PYMAVLINK_ROOMS = ("mavlink/dialect", "sim/")
"""Tables, and the simulated autopilot with its tools."""
CORE_WITHOUT_KEYS = {
    f"uavlinkd.core.{name}" for name in ("constants", "drops", "limits", "outputs", "suites", "wire")
}
"""What of the core holds no key and can use none."""


def modules(*rooms: str) -> Iterator[tuple[str, str]]:
    """Path below the package and source of every module in these rooms; of all without one."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if not rooms or name.startswith(rooms):
            yield name, path.read_text()


def imports(name: str, source: str) -> set[str]:
    """Every module, in full, that a source imports anywhere in it, also for type checking alone.

    ``from a import b`` counts as ``a`` and as ``a.b``: b may be a module.
    """
    package = ["uavlinkd", *name.split("/")[:-1]]
    found = set[str]()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("__import__", "importlib.import_module"):
            found.add("importlib")
    return found


def roots(name: str, source: str) -> set[str]:
    """The first parts of what a source imports."""
    return {each.split(".")[0] for each in imports(name, source)}


LABORATORY = ("evaluation/paper.py", "evaluation/paper_protocol.py")


def belongs(module: str, package: str) -> bool:
    """Whether a module is this package or inside of it."""
    return module == package or module.startswith(package + ".")


def impure_core(name: str, source: str) -> set[str]:
    """Wall 1: what of the world a module of the core reaches."""
    foreign = roots(name, source) & {*IMPURE, "importlib"}
    ours = {each for each in imports(name, source) if belongs(each, "uavlinkd")}
    return foreign | {each for each in ours if each != "uavlinkd" and not belongs(each, "uavlinkd.core")}


def stray_cryptography(name: str, source: str) -> set[str]:
    """Wall 1: cryptography outside the one module of the core that may import it.

    Beyond the core, key files are checked through the core's own functions. The laboratory repeats the paper's own
    protocol, which the core must not be able to speak.
    """
    return (
        set()
        if name in {"core/crypto.py", *LABORATORY}
        else roots(name, source) & {"cryptography", "hashlib", "hmac"}
    )


def keys_of_the_attacker(name: str, source: str) -> set[str]:
    """Wall 2: what the attacker imports of the core beyond its wire format."""
    found = {each for each in imports(name, source) if belongs(each, "uavlinkd.core")}
    allowed = {"uavlinkd.core"}
    return {
        each
        for each in found
        if each not in allowed and not any(belongs(each, module) for module in CORE_WITHOUT_KEYS)
    } | (roots(name, source) & {"cryptography"})


def laboratory(name: str, source: str) -> set[str]:
    """Wall 2: what the daemon and its rooms import of the evaluation, beside the commands that run it."""
    if name.startswith(("evaluation/", "cli", "commands")):
        return set()
    return {each for each in imports(name, source) if belongs(each, "uavlinkd.lab.evaluation")}


def decoding(name: str, source: str) -> set[str]:
    """Wall 3: pymavlink outside tables and tools."""
    return set() if name.startswith(PYMAVLINK_ROOMS) else roots(name, source) & {"pymavlink"}


Wall = Callable[[str, str], set[str]]


def holes(wall: Wall, *rooms: str) -> dict[str, set[str]]:
    """Where a wall is broken, and by what."""
    found = {name: wall(name, source) for name, source in modules(*rooms)}
    return {name: what for name, what in found.items() if what}


def test_core_is_sans_io() -> None:
    """Nothing in the core reaches a socket, a clock, a log, chance, or any other room."""
    assert list(modules("core/"))
    assert holes(impure_core, "core/") == {}


def test_core_calls_no_clock_or_chance_by_another_way() -> None:
    """The core neither opens files nor asks the interpreter for what it may not import."""
    for name, source in modules("core/"):
        called = {ast.unparse(node.func) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)}
        assert not called & {"open", "print", "input", "eval", "exec", "__import__", "globals"}, name


def test_cryptography_has_one_importer() -> None:
    """Only core/crypto.py imports cryptography; within the core it alone imports hashes too."""
    assert {name: what for name, what in holes(stray_cryptography).items() if "cryptography" in what} == {}
    assert holes(stray_cryptography, "core/") == {}


def test_attacker_holds_no_key() -> None:
    """The man in the middle knows the wire format and nothing of the keys."""
    assert holes(keys_of_the_attacker, "mitm/") == {}


def test_daemon_imports_nothing_of_the_laboratory() -> None:
    """What shows why bare DH fails is not within reach of what flies."""
    assert holes(laboratory) == {}


def test_pymavlink_is_for_tables_and_tools() -> None:
    """No frame on its way is decoded by pymavlink."""
    assert holes(decoding) == {}


PLANTED: list[tuple[Wall, str, str]] = [
    (impure_core, "core/peer.py", "import time"),
    (impure_core, "core/peer.py", "from os import urandom"),
    (impure_core, "core/peer.py", "def f():\n    import asyncio.events"),
    (impure_core, "core/peer.py", "if TYPE_CHECKING:\n    import structlog"),
    (impure_core, "core/peer.py", "try:\n    import random as dice\nexcept ImportError: pass"),
    (impure_core, "core/peer.py", "__import__('socket')"),
    (impure_core, "core/peer.py", "from uavlinkd.config import model"),
    (impure_core, "core/peer.py", "from ..log import setup"),
    (impure_core, "core/peer.py", "from uavlinkd import keys"),
    (stray_cryptography, "core/kem.py", "from cryptography.hazmat.primitives.asymmetric import dh"),
    (stray_cryptography, "core/kem.py", "import hashlib"),
    (stray_cryptography, "keys.py", "import cryptography"),
    (keys_of_the_attacker, "mitm/attacks.py", "from uavlinkd.core.crypto import KeyPair"),
    (keys_of_the_attacker, "mitm/attacks.py", "from uavlinkd.core import crypto"),
    (keys_of_the_attacker, "mitm/attacks.py", "from uavlinkd.core import wire, noise"),
    (keys_of_the_attacker, "mitm/attacks.py", "from ..core.node import Node"),
    (keys_of_the_attacker, "mitm/attacks.py", "import uavlinkd.core.session"),
    (keys_of_the_attacker, "mitm/proxy.py", "from cryptography.hazmat.primitives import hashes"),
    (laboratory, "daemon.py", "from uavlinkd.lab.evaluation import lab"),
    (laboratory, "core/node.py", "import uavlinkd.lab.evaluation.bare_dh"),
    (laboratory, "mitm/proxy.py", "from ..evaluation.lab import relay"),
    (decoding, "mavlink/frames.py", "from pymavlink import mavutil"),
    (decoding, "daemon.py", "def f():\n    import pymavlink.mavutil"),
]


@pytest.mark.parametrize(("wall", "name", "source"), PLANTED)
def test_planted_hole_is_seen(wall: Wall, name: str, source: str) -> None:
    """Each wall notices an import that it forbids, however it is written."""
    assert wall(name, source)


@pytest.mark.parametrize(
    ("wall", "name", "source"),
    [
        (impure_core, "core/peer.py", "from uavlinkd.core import wire\nimport struct"),
        (stray_cryptography, "core/crypto.py", "import hashlib, cryptography"),
        (keys_of_the_attacker, "mitm/attacks.py", "from uavlinkd.core import wire, constants\nimport random"),
        (keys_of_the_attacker, "mitm/attacks.py", "from uavlinkd.core.wire import parse_initiation"),
        (laboratory, "evaluation/report.py", "from uavlinkd.lab.evaluation import lab"),
        (decoding, "sim/autopilot.py", "from pymavlink import mavutil"),
        (decoding, "mavlink/dialect_generate.py", "from pymavlink.dialects.v20 import all"),
    ],
)
def test_door_is_open(wall: Wall, name: str, source: str) -> None:
    """What a wall allows it lets through."""
    assert wall(name, source) == set()


def test_what_the_attacker_may_import_holds_no_key() -> None:
    """The modules open to the attacker import no cryptography, directly or through others."""
    sources = {f"uavlinkd.{name.removesuffix('.py').replace('/', '.')}": (name, text) for name, text in modules()}
    todo, seen = list(CORE_WITHOUT_KEYS), set[str]()
    while todo:
        module = todo.pop()
        if module in seen or module not in sources:
            continue
        seen.add(module)
        todo += imports(*sources[module])
    assert not CORE_WITHOUT_KEYS - seen
    assert "uavlinkd.core.crypto" not in seen


def test_public_names_of_the_core_are_explained() -> None:
    """Every module, class, function and method of the core without an underscore has a docstring."""
    for found in pkgutil.iter_modules(core.__path__, "uavlinkd.core."):
        module = importlib.import_module(found.name)
        assert module.__doc__, found.name
        for name, thing in vars(module).items():
            if name.startswith("_") or getattr(thing, "__module__", None) != found.name:
                continue
            if inspect.isclass(thing) or inspect.isfunction(thing):
                assert thing.__doc__, f"{found.name}.{name}"
            if inspect.isclass(thing):
                for method_name, method in vars(thing).items():
                    if inspect.isfunction(method) and not method_name.startswith("_"):
                        assert method.__doc__, f"{found.name}.{name}.{method_name}"
