"""The boundaries between packages, checked on every import of the source, and that each check finds a violation."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Callable

import pytest

from tests.imports import PACKAGE, circle, graph, imports, is_inside, parsed, roots, sources

ORDER = (
    *("system", "protocol", "authority", "mavlink", "io", "limits", "config", "ops", "daemon"),
    *("serial", "relay", "tls", "fleet", "stations", "web", "lab", "observe", "parts", "cli", "__main__"),
)
"""Each package may import those before it. The heart comes first, the features follow it."""
PLACES = {
    **dict.fromkeys(("uavlinkd.relay.bindings", "uavlinkd.relay.forwarding", "uavlinkd.tls.channel"), "limits"),
    "uavlinkd.daemon.daemon": "parts",
}
"""Modules that stand elsewhere in this order than their packages: ``limits`` are those of features, which the
configuration reads; ``parts`` puts a daemon together."""
PUTS_TOGETHER = "uavlinkd.daemon.parts"
"""The one module of the daemon that imports features. They register themselves there."""
ORDER_OF_LABORATORY = ("child_processes", "mitm", "hostile", "sim", "evaluation", "demo", "commands")
"""Each part of the laboratory may import those before it."""
IMPURE = {
    *("asyncio", "concurrent", "multiprocessing", "select", "selectors", "signal", "socket", "ssl", "threading"),
    *("datetime", "time", "uuid", "random", "secrets"),
    *("io", "logging", "os", "pathlib", "structlog", "subprocess", "sys", "tempfile"),
}
"""Modules with sockets, clocks, logs, files, threads or random numbers."""
USERS_OF_PYMAVLINK = ("lab/sim/",)
"""The simulated autopilot with its tools."""
CORE_WITHOUT_KEYS = {
    f"uavlinkd.protocol.{name}"
    for name in (
        *("constants", "drops", "limits", "outputs", "path", "relay_records", "reports"),
        *("suites", "wire"),
    )
}
"""The modules of the core that contain no key and cannot use one."""
OF_NAMED_TUPLES = {"_replace", "_asdict", "_fields", "_make"}
HOLDERS_OF_KEYS = ("uavlinkd.lab.hostile", "uavlinkd.lab.evaluation", "uavlinkd.relay", "uavlinkd.config")
"""The packages that the man in the middle may not use, because they read or use keys."""
LAB_OF_THE_RELAY = ("uavlinkd.lab.mitm", "uavlinkd.lab.hostile")
"""The packages of the laboratory that the hostile relay may use: the others hold keys of members."""
PAPER = ("lab/evaluation/paper.py", "lab/evaluation/paper_protocol.py")
"""The paper's own protocol, which the core must not be able to speak."""

Boundary = Callable[[str, str], set[str]]
"""Returns the forbidden imports of a source, given its path and text."""


def impure_core(name: str, source: str) -> set[str]:
    """Boundary 1: imports with which a module of the core would reach sockets, clocks, files or other packages."""
    ours = {module for module in imports(name, source) if is_inside(module, "uavlinkd")}
    others = {module for module in ours if module != "uavlinkd" and not is_inside(module, "uavlinkd.protocol")}
    return others | roots(name, source) & {*IMPURE, "importlib"}


def stray_cryptography(name: str, source: str) -> set[str]:
    """Boundary 1: cryptography outside ``protocol/crypto.py``, whose functions others use, and WireGuard's own."""
    if name in {"protocol/crypto.py", "stations/primitives.py", *PAPER}:
        return set()
    return roots(name, source) & {"cryptography", "hashlib", "hmac"}


def keys_of_the_attacker(name: str, source: str) -> set[str]:
    """Boundary 2: imports of the attacker from packages with keys, and from the core, except its wire format."""
    all_imports = imports(name, source)
    modules = {module for module in all_imports if is_inside(module, "uavlinkd.protocol")}
    secret = {module for module in modules if not any(is_inside(module, open_) for open_ in CORE_WITHOUT_KEYS)}
    holders = {module for module in all_imports if any(is_inside(module, holder) for holder in HOLDERS_OF_KEYS)}
    return (secret - {"uavlinkd.protocol"}) | holders | roots(name, source) & {"cryptography"}


def keys_of_a_member(name: str, source: str) -> set[str]:
    """Boundary 2: imports with which the hostile relay would get a key that is not a relay's."""
    of_lab = {module for module in imports(name, source) if is_inside(module, "uavlinkd.lab")}
    others = {module for module in of_lab if not any(is_inside(module, lab) for lab in LAB_OF_THE_RELAY)}
    return others | {module for module in imports(name, source) if is_inside(module, "uavlinkd.config.keys")}


def laboratory(name: str, source: str) -> set[str]:
    """Boundary 2: imports of the laboratory, except in the commands that start it."""
    if name.startswith(("lab/", "cli")):
        return set()
    return {module for module in imports(name, source) if is_inside(module, "uavlinkd.lab")}


def decoding(name: str, source: str) -> set[str]:
    """Boundary 3: pymavlink outside tables and tools."""
    return set() if name.startswith(USERS_OF_PYMAVLINK) else roots(name, source) & {"pymavlink"}


def violations(boundary: Boundary, *folders: str) -> dict[str, set[str]]:
    """The files that cross a boundary, each with its forbidden imports."""
    forbidden = {name: boundary(name, source) for name, source in sources(*folders)}
    return {name: modules for name, modules in forbidden.items() if modules}


def package_of(module: str) -> str:
    """``uavlinkd.protocol.node`` is in ``protocol``. The name is empty for ``uavlinkd`` itself."""
    return PLACES.get(module) or f"{module}.".split(".")[1]


def test_packages_import_in_one_direction() -> None:
    """The packages form an acyclic graph, including imports for type checking only."""
    forbidden = [
        f"{module} imports {other}"
        for module, others in graph().items()
        for other in others
        if package_of(other) and ORDER.index(package_of(other)) > ORDER.index(package_of(module))
        if module != PUTS_TOGETHER
    ]
    assert forbidden == []


def test_parts_of_the_laboratory_import_in_one_direction() -> None:
    """The man in the middle needs no simulator, and the simulator no evaluation."""
    part = {module: f"{module}..".split(".")[2] for module in graph() if is_inside(module, "uavlinkd.lab")}
    forbidden = [
        f"{module} imports {other}"
        for module, of_module in part.items()
        for other in graph()[module] & part.keys()
        if part[other] and ORDER_OF_LABORATORY.index(part[other]) > ORDER_OF_LABORATORY.index(of_module)
    ]
    assert forbidden == []


@pytest.mark.parametrize("package", ORDER)
def test_modules_of_a_package_import_in_one_direction(package: str) -> None:
    """No modules import each other in a circle, not even for type checking."""
    inside = {module: others for module, others in graph().items() if package_of(module) == package}
    assert inside
    assert circle(inside) == []


def test_packages_do_not_share_class_names() -> None:
    """A public class can be found by its name alone."""
    packages = defaultdict[str, set[str]](set)
    for name, source in sources():
        for node in parsed(source).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                packages[node.name].add(name.rpartition("/")[0])
    assert {name: places for name, places in packages.items() if len(places) > 1} == {}


def test_core_is_sans_io() -> None:
    """The core imports no sockets, clocks, logs, random numbers, nor other packages of the project."""
    assert list(sources("protocol/"))
    assert violations(impure_core, "protocol/") == {}


def test_core_has_no_other_access_to_its_environment() -> None:
    """The core opens no files, and does not import at run time what it may not import."""
    for name, source in sources("protocol/"):
        called = {ast.unparse(node.func) for node in ast.walk(parsed(source)) if isinstance(node, ast.Call)}
        assert not called & {"open", "print", "input", "eval", "exec", "__import__", "globals"}, name


def test_cryptography_has_one_importer() -> None:
    """Only ``protocol/crypto.py`` imports cryptography. In the core, it is also the only one that imports hashes."""
    assert {
        name: modules for name, modules in violations(stray_cryptography).items() if "cryptography" in modules
    } == {}
    assert violations(stray_cryptography, "protocol/") == {}


def test_attacker_holds_no_key() -> None:
    """The man in the middle imports the wire format and no keys, nor the relay that holds one."""
    assert violations(keys_of_the_attacker, "lab/mitm/") == {}


def test_hostile_relay_holds_only_the_key_of_a_relay() -> None:
    """It gets its key from the file of a relay, which has the public keys of members. It makes no other key."""
    assert list(sources("lab/hostile/"))
    assert violations(keys_of_a_member, "lab/hostile/") == {}


def test_laboratory_is_imported_by_its_commands_only() -> None:
    """The daemon cannot reach attacks, simulations or the paper's protocol."""
    assert violations(laboratory) == {}


def test_pymavlink_is_for_tables_and_tools() -> None:
    """The daemon does not decode frames with pymavlink."""
    assert violations(decoding) == {}


@pytest.mark.parametrize(
    ("boundary", "name", "source"),
    [
        (impure_core, "protocol/peer.py", "import time"),
        (impure_core, "protocol/peer.py", "if TYPE_CHECKING:\n    from os import urandom"),
        (impure_core, "protocol/peer.py", "__import__('socket')"),
        (impure_core, "protocol/peer.py", "from ..ops.log import setup"),
        (stray_cryptography, "protocol/kem.py", "import hashlib"),
        (keys_of_the_attacker, "lab/mitm/attacks.py", "from uavlinkd.protocol import wire, noise"),
        (keys_of_the_attacker, "lab/mitm/proxy.py", "from cryptography.hazmat.primitives import hashes"),
        (keys_of_the_attacker, "lab/mitm/proxy.py", "from uavlinkd.relay import service"),
        (keys_of_a_member, "lab/hostile/hostile_relay.py", "from uavlinkd.lab.evaluation.pair import Pair"),
        (keys_of_a_member, "lab/hostile/hostile_relay.py", "from uavlinkd.config.keys import generate_private_key"),
        (laboratory, "daemon/daemon.py", "from uavlinkd.lab.sim.loopback_ports import free_port"),
        (decoding, "daemon/daemon.py", "def f():\n    import pymavlink.mavutil"),
    ],
)
def test_violation_is_found(boundary: Boundary, name: str, source: str) -> None:
    """Each boundary finds a forbidden import, in whatever form it is written."""
    assert boundary(name, source)


def test_modules_open_to_the_attacker_hold_no_key() -> None:
    """The modules that the attacker may import do not import cryptography, directly or through others."""
    todo, reached = list(CORE_WITHOUT_KEYS), set[str]()
    while todo:
        module = todo.pop()
        if module not in reached:
            reached.add(module)
            todo += graph()[module]
    assert reached >= CORE_WITHOUT_KEYS
    assert "uavlinkd.protocol.crypto" not in reached


HEART = ("protocol", "mavlink", "io", "daemon", "system")
"""The rooms whose private attributes only their own tests name: others ask ``tests/ROOM/inside.py``."""


def _private_names(source: str) -> set[str]:
    """The private functions and attributes that a source file defines."""
    return {name for names in re.findall(r"\bdef (_[a-z]\w*)|\b(?:self|cls)\.(_[a-z]\w*)", source) for name in names}


def test_private_attributes_of_the_heart_stay_in_their_room() -> None:
    """A redesign of a room breaks its own tests and one file, and no test of another room."""
    rooms = defaultdict[str, set[str]](set)
    for name, source in sources():
        for private in _private_names(source):
            rooms[private].add(name.split("/")[0])
    of_heart = {name: its for name, its in rooms.items() if its <= {*HEART}}
    tests = PACKAGE.parent / "tests"
    for path in sorted(tests.rglob("*.py")):
        source, room = re.sub(r'"[^"\n]*"', "", path.read_text()), path.relative_to(tests).parts[0]
        named = {*re.findall(r"(?<!\bself)(?<!\bcls)\.(_[a-z]\w*)", source)} - OF_NAMED_TUPLES
        foreign = {name for name in named - _private_names(source) if room not in of_heart.get(name, {room})}
        assert not foreign, f"{path.relative_to(tests)}: {foreign}"
