"""The address translator (NAT) in front of one socket of a drone. It forgets mappings that carry nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.network.air import Address

IDLE_S = 30.0
"""A mapping ends after this time without a datagram from inside. RFC 4787 asks for 120 s; many devices have 30."""
_FIRST_PORT = 20_000


@dataclass
class _Mapping:
    public: Address
    used_at: float
    contacted: set[Address] = field(default_factory=set)


class Nat:
    """One public host. No public port is used twice."""

    def __init__(self, host: str, *, is_symmetric: bool, filters_by_port: bool) -> None:
        self.host = host
        self.is_symmetric = is_symmetric
        """Whether each destination gets a mapping of its own (RFC 4787: address and port-dependent)."""
        self.filters_by_port = filters_by_port
        """Whether only a destination of the mapping reaches the socket. Otherwise all can."""
        self._mappings: dict[Address | None, _Mapping] = {}
        self._ports = _FIRST_PORT

    def outward(self, destination: Address, now: float) -> Address:
        """The public source address of a datagram from inside."""
        key = destination if self.is_symmetric else None
        mapping = self._mappings.get(key)
        if mapping is None or now >= mapping.used_at + IDLE_S:
            self._ports += 1
            mapping = self._mappings[key] = _Mapping((self.host, self._ports), now)
        mapping.used_at = now
        mapping.contacted.add(destination)
        return mapping.public

    def admits(self, public: Address, source: Address, now: float) -> bool:
        """Whether a datagram to a public address reaches the socket."""
        return any(
            mapping.public == public
            and now < mapping.used_at + IDLE_S
            and (not self.filters_by_port or source in mapping.contacted)
            for mapping in self._mappings.values()
        )

    def forget(self, *, keeps_ports: bool = False) -> None:
        """Forget all mappings, as after a restart of the device. ``keeps_ports``: new ones get the same ports."""
        if keeps_ports:
            for mapping in self._mappings.values():
                mapping.contacted.clear()
        else:
            self._mappings.clear()
