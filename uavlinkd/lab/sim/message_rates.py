"""The periodic messages: which are sent, at which rate, and when the next is due."""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

MAX_RATE_HZ: Final = 1000.0
# Messages later than this are skipped, so that a pause is not followed by a burst of outdated messages.
MAX_LATE_S: Final = 0.25

# The groups of REQUEST_DATA_STREAM, as in ArduCopter (only simulated messages).
GROUPS: Final[dict[int, tuple[int, ...]]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (mavlink.MAVLINK_MSG_ID_RAW_IMU, mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_MISSION_CURRENT,
    ),
    mavlink.MAV_DATA_STREAM_POSITION: (
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    ),
    mavlink.MAV_DATA_STREAM_EXTRA1: (mavlink.MAVLINK_MSG_ID_ATTITUDE,),
    mavlink.MAV_DATA_STREAM_EXTRA2: (mavlink.MAVLINK_MSG_ID_VFR_HUD,),
    mavlink.MAV_DATA_STREAM_EXTRA3: (mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, mavlink.MAVLINK_MSG_ID_SYSTEM_TIME),
}


def default_rates(attitude_rate_hz: float, position_rate_hz: float) -> dict[int, float]:
    """Messages per second until a ground station requests other rates. 0: only on request."""
    return {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
        mavlink.MAVLINK_MSG_ID_ATTITUDE: attitude_rate_hz,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0.0,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: position_rate_hz,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: position_rate_hz,
        mavlink.MAVLINK_MSG_ID_VFR_HUD: 2.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
        mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
        mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: 1.0,
        mavlink.MAVLINK_MSG_ID_RAW_IMU: 0.0,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 0.0,
    }


class Streams:
    """The schedule of periodic messages. Times are monotonic seconds."""

    def __init__(self, rates: dict[int, float], now: float) -> None:
        self._default = dict(rates)
        self._rate = dict(rates)
        self._due_at = {message: now for message, rate in rates.items() if rate > 0}
        self.next_due_at = min(self._due_at.values())

    def rate_hz(self, message: int) -> float | None:
        """The rate of a message; None if it is not a periodic message."""
        return self._rate.get(message)

    def set_rate(self, message: int, rate_hz: float | None, now: float) -> bool:
        """Change a rate; 0 stops the message, None restores the default. False if it is not a periodic message.

        The heartbeat keeps its rate: without it, ground stations lose the vehicle.
        """
        if message not in self._rate or message == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return False
        rate = self._default[message] if rate_hz is None else min(max(rate_hz, 0.0), MAX_RATE_HZ)
        self._rate[message] = rate
        if rate == 0:
            self._due_at.pop(message, None)
        else:
            self._due_at[message] = min(self._due_at.get(message, now), now + 1 / rate)
        self.next_due_at = min(self._due_at.values())
        return True

    def set_group(self, group: int, rate_hz: float, now: float) -> bool:
        """Change the rates of a MAV_DATA_STREAM, or of all of them. False if it is unknown."""
        groups = list(GROUPS) if group == mavlink.MAV_DATA_STREAM_ALL else [group]
        if not GROUPS.keys() >= set(groups):
            return False
        for message in (message for number in groups for message in GROUPS[number]):
            self.set_rate(message, rate_hz, now)
        return True

    def take_due(self, now: float) -> list[int]:
        """The messages to send now, in the order they were due. Schedules their next times."""
        if now < self.next_due_at:
            return []
        due: list[tuple[float, int]] = []
        for message, at in self._due_at.items():
            interval = 1 / self._rate[message]
            next_at = at
            if now - next_at > max(MAX_LATE_S, interval):
                next_at = now
            while next_at <= now:
                due.append((next_at, message))
                next_at += interval
            self._due_at[message] = next_at
        self.next_due_at = min(self._due_at.values())
        return [message for _, message in sorted(due)]
