"""Two real drones that refuse commands of each other, and report that."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Mapping
from struct import Struct
from typing import Any, Final

from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.mavlink.dialect import IDS, MESSAGES

_REFUSED: Final = "MAV_CMD_COMPONENT_ARM_DISARM"
_COMMAND: Final = Struct("<7fHBBB")
_COMMAND_LONG: Final = IDS["COMMAND_LONG"]
_ARM: Final = 400
_COMMANDS_INTERVAL_S: Final = 0.2


class RefusingStage(DaemonStage):
    """Two drones that refuse commands of each other, and report that: are the claims that they show true?"""

    def rules(self, one: str, other: str) -> dict[str, object]:
        return {**super().rules(one, other), "deny_in": [_REFUSED]}

    false_claims = 0

    async def _talk(self) -> None:
        await asyncio.gather(super()._talk(), self._send_commands(), self._check_claims())

    async def _send_commands(self) -> None:
        seq = 0
        while True:
            for number, name in enumerate(self.names):
                self.send(name, arm_command(number + 1, seq))
            seq = (seq + 1) % 256
            await asyncio.sleep(_COMMANDS_INTERVAL_S)

    async def _check_claims(self) -> None:
        """A drone claims at most what it has refused when it is asked afterwards."""
        while True:
            await asyncio.sleep(_COMMANDS_INTERVAL_S)
            for shown_by, claimed_by in (self.names, self.names[::-1]):
                claims = claims_of(await self.drones[shown_by].ask(), claimed_by)
                refused = refused_by(await self.drones[claimed_by].ask(), shown_by)
                self.false_claims += (claims - refused).total()


def arm_command(system: int, seq: int) -> bytes:
    payload = _COMMAND.pack(1.0, *(0.0,) * 6, _ARM, 3 - system, 1, 0)
    return mavlink_frame(_COMMAND_LONG, payload, MESSAGES[_COMMAND_LONG][1], system, seq)


def claims_of(status: Mapping[str, Any], peer: str) -> Counter[str]:
    """What a drone's status shows as the claims of its peer."""
    peers = status.get("peers", {})
    listed = peers[peer]["refused_there"] if peer in peers else []
    return Counter({f"{claim['command'] or claim['message']} {claim['reason']}": claim["count"] for claim in listed})


def refused_by(status: Mapping[str, Any], peer: str) -> Counter[str]:
    """What a drone has refused of its peer's commands."""
    peers = status.get("peers", {})
    commands = peers[peer]["refused_commands"]["in"] if peer in peers else {}
    return Counter({f"{command} {reason}": n for command, counts in commands.items() for reason, n in counts.items()})
