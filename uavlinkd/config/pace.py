"""How often a link with a budget may verify that what arrives is new."""

from __future__ import annotations

from typing import Final

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.system.addresses import IPV6_UDP_BYTES

VERIFYING_SHARE: Final = 0.05
"""Share of the budget that the echo requests and replies of one end may use."""


def verify_interval_s(budget_bits_s: int, tag_bytes: int) -> float:
    """Seconds between two echo requests, at least :data:`c.VERIFY_INTERVAL_S`. A budget of 0 means unlimited.

    The request and its reply count, with the long header and over IPv6: their largest size.
    """
    if not budget_bits_s:
        return c.VERIFY_INTERVAL_S
    records = sum(len(wire.Echo(is_reply, 0, 0, 0).encode()) for is_reply in (False, True))
    wire_bytes = records + 2 * (wire.LONG_HEADER_BYTES + tag_bytes + IPV6_UDP_BYTES)
    return max(c.VERIFY_INTERVAL_S, 8 * wire_bytes / (VERIFYING_SHARE * budget_bits_s))
