"""Handing the fleet's bulletin to a running daemon, which passes it on."""

from __future__ import annotations

import time
from pathlib import Path

from uavlinkd.authority.trust import BulletinVerdict
from uavlinkd.fleet import operations, signing
from uavlinkd.fleet.authority_key import Passphrase
from uavlinkd.fleet.manifest import Fleet, FleetError, read_manifest
from uavlinkd.ops.control import ask as ask_daemon
from uavlinkd.system.base64_text import from_base64, to_base64

_AT_ONCE = 30
"""Certificates in a request, which has at most 8,192 bytes."""
SETTLE_S = 5.0
"""Members that are linked hand new certificates to each other within this time."""


def publish(folder: Path, socket: Path, ask: Passphrase, *, merges: bool = False) -> Fleet:
    """Hand the bulletin to the daemon at a control socket, and newer certificates if all were signed again.

    The daemon may have another bulletin of the same number, which another copy of the folder signed: then their union
    is signed and handed over. ``merges``: a newer one too.
    """
    fleet = read_manifest(folder)
    theirs = from_base64(str(ask_daemon(socket, "bulletin").get("bulletin")))
    bulletin, own = signing.bulletin_of(fleet, theirs), fleet.bulletin.number
    if bulletin.number > own and not merges:
        raise FleetError(
            f"the fleet has bulletin {bulletin.number}, this folder {own}: use the newest copy of the folder. If that"
            " is lost, --merge signs the union of both; members that were signed there are not in this folder"
        )
    if bulletin.number > own or (bulletin.number == own and theirs != fleet.published):
        fleet = operations.merge(folder, theirs, ask)
    # The certificates come first: a member that meets the bulletin with its old one would be refused.
    certificates = [
        f"{to_base64(member.public_key)}:{to_base64(member.signed)}"
        for member in (fleet.current if fleet.bulletin.least > bulletin.least else ())
    ]
    for at in range(0, len(certificates), _AT_ONCE):
        ask_daemon(socket, " ".join(["publish", to_base64(theirs), *certificates[at : at + _AT_ONCE]]))
    if certificates:
        time.sleep(SETTLE_S)
    verdict = ask_daemon(socket, f"publish {to_base64(fleet.published)}").get("verdict")
    if verdict not in (BulletinVerdict.NEWER.value, BulletinVerdict.KNOWN.value):
        raise FleetError(f"the daemon refused bulletin {fleet.bulletin.number}: {verdict}")
    return fleet
