"""Another version of the protocol, in words: which side is older, and where to update.

Any sender that knows the public key can forge the message behind it. An update is safe then too.
"""

from __future__ import annotations

from uavlinkd.core import constants as c
from uavlinkd.link.evidence import Sighting
from uavlinkd.link.shown import shown


def compared(version: int) -> str:
    """The version of a sender beside this daemon's."""
    age = "older" if version < c.PROTOCOL_VERSION else "newer"
    return f"uavlink/{version}, {age} than uavlink/{c.PROTOCOL_VERSION} of this daemon,"


def other_version(sighting: Sighting, here: str, there: str) -> tuple[str, str]:
    """The text and the remedy of a finding. ``here``: this daemon's name. ``there``: the sender's, if it is known."""
    versions = sorted(version for version in sighting.details if isinstance(version, int))
    named = " and ".join(f"uavlink/{version}" for version in versions)
    at = "its address" if sighting.address is None else shown(sighting.address)
    text = f"a sender at {at} speaks {named}, this daemon uavlink/{c.PROTOCOL_VERSION}: the two cannot link"
    remedies = []
    if min(versions) < c.PROTOCOL_VERSION:
        remedies.append(f"update uavlinkd at {there}: it is older")
    if max(versions) > c.PROTOCOL_VERSION:
        remedies.append(f"update uavlinkd at {here}, this machine: it is older")
    return text, "; ".join(remedies)
