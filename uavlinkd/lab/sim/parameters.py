"""The parameters of the simulated copter, with ArduPilot's names, types and behaviour."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final


class ParameterType(IntEnum):
    """The types of MAV_PARAM_TYPE that ArduPilot uses. Values of all types are sent as float32."""

    INT8 = 2
    INT16 = 4
    INT32 = 6
    REAL32 = 9


_FORMATS: Final = {
    ParameterType.INT8: "<b",
    ParameterType.INT16: "<h",
    ParameterType.INT32: "<i",
    ParameterType.REAL32: "<f",
}


@dataclass(slots=True)
class Parameter:
    """One parameter. The value is a float32."""

    name: str
    kind: ParameterType
    value: float
    read_only: bool = False


def _defaults(system_id: int) -> list[Parameter]:
    i8, i16, i32, real = ParameterType.INT8, ParameterType.INT16, ParameterType.INT32, ParameterType.REAL32
    return [
        Parameter("FORMAT_VERSION", i16, 120, read_only=True),
        Parameter("SYSID_THISMAV", i16, system_id, read_only=True),
        Parameter("SYSID_MYGCS", i16, 255),
        Parameter("FRAME_CLASS", i8, 1),
        Parameter("FRAME_TYPE", i8, 1),
        Parameter("ARMING_CHECK", i32, 1),
        Parameter("AHRS_ORIENTATION", i8, 0),
        Parameter("BATT_MONITOR", i8, 4),
        Parameter("BATT_CAPACITY", i32, 5200),
        Parameter("COMPASS_USE", i8, 1),
        Parameter("FENCE_ENABLE", i8, 0),
        Parameter("FENCE_RADIUS", real, 300.0),
        Parameter("LAND_SPEED", i16, 100),
        Parameter("LOG_BITMASK", i32, 176_126),
        Parameter("MIS_TOTAL", i16, 0, read_only=True),
        Parameter("PILOT_TKOFF_ALT", real, 500.0),
        Parameter("RTL_ALT", i32, 1500),
        Parameter("STAT_BOOTCNT", i16, 1, read_only=True),
        Parameter("WPNAV_SPEED", real, 800.0),
        Parameter("WPNAV_SPEED_DN", real, 150.0),
        Parameter("WPNAV_SPEED_UP", real, 250.0),
    ]


class ParameterTable:
    """All parameters, in order. Names have at most 16 ASCII letters."""

    def __init__(self, system_id: int) -> None:
        self.table = _defaults(system_id)
        self._index = {parameter.name: index for index, parameter in enumerate(self.table)}

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, name: str) -> float:
        return self.table[self._index[name]].value

    def index_of(self, name: str) -> int | None:
        """The index of a name; None if it is unknown."""
        return self._index.get(name)

    def at(self, index: int) -> Parameter | None:
        """The parameter at an index; None outside the table."""
        return self.table[index] if 0 <= index < len(self.table) else None

    def set(self, name: str, value: float) -> bool:
        """Store a value. False, without a change, if the value or the name is refused.

        As in ArduPilot, integer types round to the nearest integer. NaN, infinity, values out of range, read-only
        and unknown names are refused.
        """
        index = self._index.get(name)
        if index is None or self.table[index].read_only or not math.isfinite(value):
            return False
        parameter = self.table[index]
        is_real = parameter.kind is ParameterType.REAL32
        try:
            packed = struct.pack(_FORMATS[parameter.kind], value if is_real else math.floor(value + 0.5))
        except (struct.error, OverflowError):
            return False
        (parameter.value,) = struct.unpack(_FORMATS[parameter.kind], packed)
        return True

    def preset(self, name: str, value: float) -> None:
        """Write a value that the vehicle maintains, such as MIS_TOTAL."""
        self.table[self._index[name]].value = value
