"""An internet of our own, with places behind routers of every kind::

    with Laboratory() as laboratory:
        relay = laboratory.public()
        drone = laboratory.place("symmetric")
        subprocess.run([*drone.host.launcher, "uavlinkd", "run", ...])

Addresses of the internet are from 11.0.0.0/8: software takes those for documentation (RFC 5737) for private ones. No
packet leaves the namespaces.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from ipaddress import IPv4Network
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from tests.natlab.kinds import KINDS, Chain, Filter, LinuxNat, Nat, Router, Wire
from tests.natlab.namespaces import LaboratoryError, Namespace, connect, remove_leftovers
from uavlinkd.lab.child_processes import end_with_parent

HOME: Final = "192.168.1.{}"
"""Every home uses the same addresses, as they do."""
CARRIER: Final = "100.64.{}.{}"
PUBLIC: Final = "11.0.{}.{}"
_CABLE: Final = IPv4Network("169.254.0.0/16")
"""Every cable between routers has two addresses of its own: Linux does not answer a question (ARP) that seems to come
from one of its own addresses."""
_ROOT: Final = Path(__file__).parents[2]


@dataclass(eq=False)
class _Node:
    """A namespace that forwards, and the interfaces to those below it."""

    namespace: Namespace
    router: Router | None
    external: str
    """The address that others see of what is behind it, where it translates."""

    def __post_init__(self) -> None:
        self.numbers = count(2)

    @property
    def translates(self) -> bool:
        return isinstance(self.router, Nat | LinuxNat)


@dataclass(frozen=True, eq=False)
class Place:
    """A host, and the routers between it and the internet, the outermost first."""

    kind: str
    host: Namespace
    address: str
    """The host's own."""
    external: str
    """That under which the internet sees it."""
    laboratory: Laboratory
    nodes: tuple[_Node, ...]
    second_address: str = ""
    """Of a public host that has two."""

    def housemate(self) -> Place:
        """Another host in the same home, behind the same routers."""
        assert self.nodes[-1].translates, "no home network there"
        return self.laboratory.place_behind(self.kind, self.nodes, ())

    def neighbour(self) -> Place:
        """A host in another home behind the same carrier's router."""
        carrier, *_ = translators = [node for node in self.nodes if node.translates]
        assert len(translators) == 2, "no carrier there"
        shared = self.nodes[: self.nodes.index(carrier) + 1]
        routers = tuple(node.router for node in self.nodes[len(shared) :] if node.router is not None)
        return self.laboratory.place_behind(self.kind, shared, routers)

    def forget(self) -> None:
        """Let its routers forget all mappings and connections."""
        for node in self.nodes:
            self.laboratory.forget(node)


class Laboratory:
    """Namespaces and one process that forwards; all gone at the end of the block, however it ends."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._publics = count(1)
        self._cables = _CABLE.hosts()
        self._control: socket.socket | None = None
        self.internet = Namespace()
        self._internet = _Node(self.internet, None, "")

    def __enter__(self) -> Self:
        remove_leftovers()
        with ExitStack() as stack:  # for a start that fails half-way
            self._stack = stack
            self._make(self.internet)
            self.internet.ip("route add blackhole default")
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def public(self) -> Place:
        """A host on the internet with two addresses, such as for a relay."""
        network = next(self._publics)
        first, second = (PUBLIC.format(network, number) for number in (2, 3))
        return Place("open", self._host(self._internet, [first, second]), first, first, self, (), second)

    def place(self, kind: str | Chain, *, delay_s: float = 0.0, loss: float = 0.0) -> Place:
        """A host behind routers, and with a line to the internet that delays and loses packets in each direction."""
        chain = KINDS[kind] if isinstance(kind, str) else kind
        line = (Wire(delay_s, loss),) if delay_s or loss else ()
        return self.place_behind(kind if isinstance(kind, str) else "own", (), (*line, *chain))

    def place_behind(self, kind: str, shared: Sequence[_Node], chain: Chain) -> Place:
        """A host behind these routers, and below them new ones."""
        nodes = list(shared)
        upper = nodes[-1] if nodes else self._internet
        address = upper.external if nodes else PUBLIC.format(next(self._publics), 2)
        external = next((node.external for node in nodes if node.translates), address)
        for number, router in enumerate(chain):
            if upper.translates:
                address = CARRIER.format(0, next(upper.numbers))
            upper = self._router(upper, router, address, is_home=number == len(chain) - 1)
            nodes.append(upper)
        if upper.translates:
            address = HOME.format(next(upper.numbers))
        return Place(kind, self._host(upper, [address]), address, external, self, tuple(nodes))

    def forget(self, node: _Node) -> None:
        """Let one router forget all mappings and connections."""
        if isinstance(node.router, Nat):
            self._ask({"name": node.namespace.name})
        elif not isinstance(node.router, Wire):
            node.namespace.forget_connections()

    # How it is built.

    def _make(self, namespace: Namespace) -> None:
        self._stack.callback(namespace.close)
        namespace.open()

    def _host(self, upper: _Node, addresses: Sequence[str]) -> Namespace:
        host = Namespace()
        self._make(host)
        device = f"down{next(upper.numbers)}"
        connect(upper.namespace, device, host)
        if upper.translates:
            upper.namespace.ip(f"link set {device} master lan")
            host.ip(*(f"addr add {address}/24 dev wan" for address in addresses))
            host.ip(f"route add default via {HOME.format(1)}")
        else:
            host.ip(*(f"addr add {address}/32 dev wan" for address in addresses))
            above = next(self._cables)
            host.ip(f"route add default via {above} dev wan onlink")
            upper.namespace.ip(f"addr add {above}/32 dev {device}")
            upper.namespace.ip(*(f"route add {address}/32 dev {device}" for address in addresses))
        return host

    def _router(self, upper: _Node, router: Router, address: str, *, is_home: bool) -> _Node:
        """A router for this address, below another one."""
        namespace = Namespace()
        self._make(namespace)
        node = _Node(namespace, router, address)
        device = f"down{next(upper.numbers)}"
        connect(upper.namespace, device, namespace)
        above, below = next(self._cables), next(self._cables)
        upper.namespace.ip(
            f"addr add {above}/32 dev {device}", f"route add {address}/32 via {below} dev {device} onlink"
        )
        namespace.ip(f"addr add {below}/32 dev wan", f"route add default via {above} dev wan onlink")
        if node.translates and is_home:
            namespace.ip("link add lan type bridge", f"addr add {HOME.format(1)}/24 dev lan", "link set lan up")
        match router:
            case Nat():
                inner = f"{HOME.format(0)}/24" if is_home else f"{CARRIER.format(0, 0)}/10"
                self._add_forwarding(namespace, {"external": address, "inner": inner, **asdict(router)})
            case Wire():
                self._add_forwarding(namespace, asdict(router))
            case LinuxNat():
                namespace.ip(f"addr add {address}/32 dev lo")
                namespace.nft(_linux_nat(address, "fully-random" if router.random_ports else ""))
            case Filter():
                namespace.nft(
                    f"table inet t {{\nchain c {{ type filter hook forward priority filter; {router.rules}; }}\n}}"
                )
        return node

    def _add_forwarding(self, namespace: Namespace, settings: dict[str, object]) -> None:
        tun = namespace.open_tun("tun")
        try:
            namespace.ip("route add default dev tun table 100", "rule add not iif tun lookup 100")
            self._ask({"name": namespace.name, "delay_s": 0.0, "loss": 0.0, **settings}, tun)
        finally:
            os.close(tun)

    def _ask(self, message: dict[str, object], *descriptors: int) -> None:
        if self._control is None:
            self._control = self._start_forwarding()
        socket.send_fds(self._control, [json.dumps(message).encode()], descriptors)
        if self._control.recv(16) != b"done":
            raise LaboratoryError("the process that forwards has ended")

    def _start_forwarding(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            process = subprocess.Popen(
                end_with_parent(sys.executable, "-m", "tests.natlab.routing"), stdin=theirs.fileno(), cwd=_ROOT
            )
        self._stack.callback(process.wait)
        self._stack.callback(ours.close)
        return ours


def _linux_nat(address: str, flags: str) -> str:
    return f"""
    table inet t {{
        chain out {{ type nat hook postrouting priority srcnat; oifname "wan" snat ip to {address} {flags}; }}
        chain in {{ type filter hook input priority filter; iifname "wan" drop; }}
        chain through {{ type filter hook forward priority filter; iifname "wan" ct state new drop; }}
    }}"""
