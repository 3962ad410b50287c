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
from ipaddress import IPv4Network, IPv6Network
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from tests.namespaces import Namespace, NamespaceError, connect, need_namespaces, remove_leftovers
from tests.natlab.kinds import FIREWALL, KINDS, Chain, Filter, LinuxNat, Nat, Router, Wire
from tests.needs import need
from uavlinkd.lab.child_processes import end_with_parent

SECOND: Final = "wan2"
"""The interface of a host's second network; that of the first is ``wan``."""
HOME: Final = "192.168.1.{}"
"""Every home uses the same addresses, as they do."""
CARRIER: Final = "100.64.{}.{}"
PUBLIC: Final = "11.0.{}.{}"
PREFIX: Final = "2fff:0:0:{:x}::"
"""A home's network of IPv6; no provider has such addresses."""
_CABLE_IPV6: Final = IPv6Network("fd00:ffff::/64")
_CABLE: Final = IPv4Network("169.254.0.0/16")
"""Every cable between routers has two addresses of its own: Linux does not answer a question (ARP) that seems to come
from one of its own addresses."""
_ROOT: Final = Path(__file__).parents[2]


def need_laboratory() -> None:
    """Skip a test that lacks what a laboratory needs."""
    need_namespaces("nft")
    need(Path("/dev/net/tun").exists(), "TUN interfaces (/dev/net/tun)")


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
    external: str
    """That under which the internet sees it."""
    laboratory: Laboratory
    nodes: tuple[_Node, ...]
    second_address: str = ""
    ipv6: str = ""
    """The host's own address of IPv6, if it has one. The internet sees it as it is."""

    def housemate(self) -> Place:
        """Another host in the same home, behind the same routers."""
        assert self.nodes[-1].translates, "no home network there"
        return self.laboratory.place_behind(self.kind, self.nodes, ())

    def neighbour(self) -> Place:
        carrier, *_ = translators = [node for node in self.nodes if node.translates]
        assert len(translators) == 2, "no carrier there"
        shared = self.nodes[: self.nodes.index(carrier) + 1]
        routers = tuple(node.router for node in self.nodes[len(shared) :] if node.router is not None)
        return self.laboratory.place_behind(self.kind, shared, routers)

    def second_network(self, kind: str) -> Place:
        """Another network of the same host, behind routers of its own. Its route is used while the first is down."""
        return self.laboratory.place_behind(kind, (), KINDS[kind], self.host)

    def forget(self) -> None:
        """Let its routers forget all mappings and connections."""
        for node in self.nodes:
            self.laboratory.forget(node)

    def lose(self, loss: float) -> None:
        """Its line, which has to have a delay, loses this share of packets in each direction from now on."""
        (wire,) = (node for node in self.nodes if isinstance(node.router, Wire))
        self.laboratory.lose(wire, loss)


class Laboratory:
    """Namespaces and one process that forwards; all gone at the end of the block, however it ends."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._publics = count(1)
        self._cables = _CABLE.hosts()
        self._ipv6_cables = _CABLE_IPV6.hosts()
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

    def public(self, *, has_ipv6: bool = False) -> Place:
        """A host on the internet with two addresses, such as for a relay."""
        network = next(self._publics)
        first, second = (PUBLIC.format(network, number) for number in (2, 3))
        prefix = PREFIX.format(network) if has_ipv6 else ""
        host = self._host(self._internet, [first, second], prefix)
        return Place("open", host, first, first, self, (), second, _host_in(prefix))

    def place(self, kind: str | Chain, *, delay_s: float = 0.0, loss: float = 0.0, has_ipv6: bool = False) -> Place:
        """A host behind routers, and with a line to the internet that delays and loses packets in each direction.

        With IPv6, only answers to its own packets come in. The line does not delay or lose those of IPv6.
        """
        chain = KINDS[kind] if isinstance(kind, str) else kind
        line = (Wire(delay_s, loss),) if delay_s or loss else ()
        prefix = PREFIX.format(next(self._publics)) if has_ipv6 else ""
        return self.place_behind(kind if isinstance(kind, str) else "own", (), (*line, *chain), prefix=prefix)

    def place_behind(
        self, kind: str, shared: Sequence[_Node], chain: Chain, host: Namespace | None = None, prefix: str = ""
    ) -> Place:
        """A host behind these routers, and below them new ones. It is new unless it is given."""
        nodes = list(shared)
        upper = nodes[-1] if nodes else self._internet
        address = upper.external if nodes else PUBLIC.format(next(self._publics), 2)
        external = next((node.external for node in nodes if node.translates), address)
        for number, router in enumerate(chain):
            if upper.translates:
                address = CARRIER.format(0, next(upper.numbers))
            upper = self._router(upper, router, address, prefix, is_home=number == len(chain) - 1)
            nodes.append(upper)
        if upper.translates:
            address = HOME.format(next(upper.numbers))
        if host is None:
            host = self._host(upper, [address], prefix)
        else:
            self._join(host, SECOND, upper, [address], prefix)
        return Place(kind, host, address, external, self, tuple(nodes), ipv6=_host_in(prefix))

    def forget(self, node: _Node) -> None:
        """Let one router forget all mappings and connections."""
        if isinstance(node.router, Nat):
            self._ask({"name": node.namespace.name})
        elif not isinstance(node.router, Wire):
            node.namespace.forget_connections()

    def lose(self, node: _Node, loss: float) -> None:
        """Let one line lose this share of packets in each direction."""
        self._ask({"name": node.namespace.name, "loss": loss})

    # How it is built.

    def _make(self, namespace: Namespace) -> None:
        self._stack.callback(namespace.close)
        namespace.open(forwards=True)

    def _host(self, upper: _Node, addresses: Sequence[str], prefix: str) -> Namespace:
        host = Namespace()
        self._make(host)
        self._join(host, "wan", upper, addresses, prefix)
        return host

    def _join(self, host: Namespace, own: str, upper: _Node, addresses: Sequence[str], prefix: str) -> None:
        """Connect an interface of a host. Only one has routes that are used while both are up."""
        device = f"down{next(upper.numbers)}"
        connect(upper.namespace, device, host, own)
        metric = "" if own == "wan" else " metric 100"
        if upper.translates:
            upper.namespace.ip(f"link set {device} master lan")
            host.ip(*(f"addr add {address}/24 dev {own}" for address in addresses))
            host.ip(f"route add default via {HOME.format(1)} dev {own}{metric}")
        else:
            host.ip(*(f"addr add {address}/32 dev {own}" for address in addresses))
            above = next(self._cables)
            host.ip(f"route add default via {above} dev {own} onlink{metric}")
            upper.namespace.ip(f"addr add {above}/32 dev {device}")
            upper.namespace.ip(*(f"route add {address}/32 dev {device}" for address in addresses))
        if prefix:
            host.ip(f"addr add {_host_in(prefix)}/64 dev {own} nodad")
            gateway = f"{prefix}1"
            if not upper.translates:
                upper.namespace.ip(f"addr add {gateway}/64 dev {device} nodad")
            host.ip(f"route add default via {gateway} dev {own}{metric}")

    def _router(self, upper: _Node, router: Router, address: str, prefix: str, *, is_home: bool) -> _Node:
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
        if prefix:
            self._add_ipv6(upper.namespace, device, namespace, prefix)
        if node.translates and is_home:
            namespace.ip("link add lan type bridge", f"addr add {HOME.format(1)}/24 dev lan", "link set lan up")
            if prefix:
                namespace.ip(f"addr add {prefix}1/64 dev lan nodad")
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
                namespace.nft(_filter("inet", router))
        return node

    def _add_ipv6(self, upper: Namespace, device: str, lower: Namespace, prefix: str) -> None:
        """Route a network of IPv6 to a router. It lets only answers in."""
        above, below = next(self._ipv6_cables), next(self._ipv6_cables)
        upper.ip(f"addr add {above}/128 dev {device} nodad", f"route add {prefix}/64 via {below} dev {device} onlink")
        lower.ip(f"addr add {below}/128 dev wan nodad", f"route add default via {above} dev wan onlink")
        lower.nft(_filter("ip6", FIREWALL))

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
            raise NamespaceError("the process that forwards has ended")

    def _start_forwarding(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            process = subprocess.Popen(
                end_with_parent(sys.executable, "-m", "tests.natlab.routing"), stdin=theirs.fileno(), cwd=_ROOT
            )
        self._stack.callback(process.wait)
        self._stack.callback(ours.close)
        return ours


def _host_in(prefix: str) -> str:
    return prefix and f"{prefix}2"


def _filter(family: str, router: Filter) -> str:
    """The rules of a router that does not translate."""
    return f"table {family} t {{\nchain c {{ type filter hook forward priority filter; {router.rules}; }}\n}}"


def _linux_nat(address: str, flags: str) -> str:
    return f"""
    table inet t {{
        chain out {{ type nat hook postrouting priority srcnat; oifname "wan" snat ip to {address} {flags}; }}
        chain in {{ type filter hook input priority filter; iifname "wan" meta nfproto ipv4 drop; }}
        chain through {{ type filter hook forward priority filter; iifname "wan" ct state new drop; }}
    }}"""
