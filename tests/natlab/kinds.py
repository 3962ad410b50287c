"""The kinds of places: the routers between a host and the internet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from tests.natlab.translation import Dependence

INDEPENDENT, ADDRESS, PORT = Dependence


@dataclass(frozen=True, slots=True)
class Nat:
    """A router that translates (:mod:`tests.natlab.translation`)."""

    mapping: Dependence
    filtering: Dependence
    hairpin: bool = False


@dataclass(frozen=True, slots=True)
class LinuxNat:
    """A Linux router. It drops unsolicited packets: answering them would let them take a mapping."""

    random_ports: bool
    """Each connection gets a random port, else the inner one where it is free."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A router that does not translate, with rules for what it forwards."""

    rules: str


@dataclass(frozen=True, slots=True)
class Wire:
    """A slow line that loses packets, the same in both directions."""

    delay_s: float = 0.0
    loss: float = 0.0


Router = Nat | LinuxNat | Filter | Wire
Chain = tuple[Router, ...]
"""From the internet inwards."""

FIREWALL: Final = Filter('iifname "wan" ct state new drop')
NO_UDP: Final = Filter("meta l4proto udp drop")
PORT_RESTRICTED: Final = Nat(INDEPENDENT, PORT)
SYMMETRIC: Final = Nat(PORT, PORT)

KINDS: Final[Mapping[str, Chain]] = MappingProxyType(
    {
        "open": (),
        "firewall": (FIREWALL,),
        "full-cone": (Nat(INDEPENDENT, INDEPENDENT),),
        "address-restricted": (Nat(INDEPENDENT, ADDRESS),),
        "port-restricted": (PORT_RESTRICTED,),
        "address-dependent": (Nat(ADDRESS, ADDRESS),),
        "symmetric": (SYMMETRIC,),
        "linux": (LinuxNat(random_ports=False),),
        "linux-random": (LinuxNat(random_ports=True),),
        "carrier": (PORT_RESTRICTED, PORT_RESTRICTED),
        "carrier-hairpin": (Nat(INDEPENDENT, PORT, hairpin=True), PORT_RESTRICTED),
        "carrier-symmetric": (SYMMETRIC, PORT_RESTRICTED),
        "no-udp": (NO_UDP,),
    }
)
PAIRED: Final = tuple(kind for kind in KINDS if not kind.endswith("hairpin"))
"""Kinds for tables of pairs. Whether a router hairpins matters only between hosts behind the same one."""
