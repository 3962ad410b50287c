"""The last HEARTBEAT and SYS_STATUS of each autopilot behind a peer, for the status: armed, mode, battery.

The frames are kept as they came, and decoded when a status is asked for.
"""

from __future__ import annotations

import struct
from typing import Any, Final

from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import Frame, payload_bytes
from uavlinkd.mavlink.payloads import HEARTBEAT, claims_to_be_ground_station

SYS_STATUS: Final = IDS["SYS_STATUS"]
REPORTS: Final = frozenset((HEARTBEAT, SYS_STATUS))
"""The messages that are kept. Other messages cost nothing."""
MOST_VEHICLES: Final = 8
"""Systems of one peer. A peer that invents systems displaces its own."""
_AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1: gimbals and cameras send heartbeats too
_ARMED: Final = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_HEARTBEAT: Final = struct.Struct("<IBBB")  # custom_mode, type, autopilot, base_mode
_BATTERY: Final = struct.Struct("<14xH14xb")  # voltage_battery in mV, battery_remaining in percent
_NO_VOLTAGE: Final = 65_535
BATTERY_S: Final = 10.0
"""An older SYS_STATUS says nothing about the battery now."""


class Vehicles:
    """The autopilots behind one peer, as they report themselves: a captured vehicle can lie. Times are monotonic."""

    __slots__ = ("_reports",)

    def __init__(self) -> None:
        self._reports: dict[int, dict[int, tuple[Frame, float]]] = {}  # by system and message

    def note(self, frame: Frame, now: float) -> None:
        """Keep a frame of :data:`REPORTS`, in place of the one before."""
        header = frame.header
        if header.component != _AUTOPILOT or not header.is_known:
            return
        if header.system not in self._reports and len(self._reports) >= MOST_VEHICLES:
            del self._reports[next(iter(self._reports))]
        self._reports.setdefault(header.system, {})[header.msgid] = frame, now

    def status(self, now: float) -> list[dict[str, Any]]:
        """Numbers of HEARTBEAT as they are; None for what the battery does not report."""
        vehicles = []
        for system, reports in sorted(self._reports.items()):
            if HEARTBEAT not in reports or claims_to_be_ground_station(reports[HEARTBEAT][0]):
                continue
            heartbeat, at = reports[HEARTBEAT]
            custom_mode, kind, autopilot, base_mode = _HEARTBEAT.unpack(_fields(heartbeat, _HEARTBEAT))
            millivolts, percent = _NO_VOLTAGE, -1
            if SYS_STATUS in reports and now - reports[SYS_STATUS][1] < BATTERY_S:
                millivolts, percent = _BATTERY.unpack(_fields(reports[SYS_STATUS][0], _BATTERY))
            vehicles.append(
                {
                    "system": system,
                    "heartbeat_s": now - at,
                    "type": kind,
                    "autopilot": autopilot,
                    "is_armed": bool(base_mode & _ARMED),
                    "custom_mode": custom_mode,
                    "battery_v": None if millivolts == _NO_VOLTAGE else millivolts / 1000,
                    "battery_percent": None if percent < 0 else percent,
                }
            )
        return vehicles


def _fields(frame: Frame, layout: struct.Struct) -> bytes:
    return payload_bytes(frame, 0, layout.size).ljust(layout.size, b"\0")
