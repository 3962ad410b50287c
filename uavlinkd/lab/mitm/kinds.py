"""The kinds of datagrams that an attack can be limited to."""

from __future__ import annotations

from typing import Final, Literal

from uavlinkd.lab.mitm.anatomy import HANDSHAKE, DatagramKind, is_echo, is_probe, is_refusal_report, kind_of

KindFilter = Literal["any", "handshake", "initiation", "response", "cookie", "envelope", "report", "probe", "frames"]
KINDS: Final = (
    "any, handshake, initiation, response, cookie, envelope, report (a refusal report in the clear), probe (by its"
    " length, or in the clear before frames), or frames (envelopes that are neither probes nor echoes)"
)


def matches_kind(kinds: KindFilter, datagram: bytes) -> bool:
    """Whether a datagram is of the kinds that the parameter names."""
    kind = kind_of(datagram)
    match kinds:
        case "any":
            return True
        case "handshake":
            return kind in HANDSHAKE
        case "report":
            return is_refusal_report(datagram)
        case "probe":
            return is_probe(datagram)
        case "frames":
            return kind is DatagramKind.ENVELOPE and not is_probe(datagram) and not is_echo(datagram)
        case _:
            return kind.value == kinds
