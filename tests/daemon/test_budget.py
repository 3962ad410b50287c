"""A slow radio: what matters arrives at once, the rest is thinned and counted, and the budget is kept to the byte."""

from __future__ import annotations

import asyncio
from collections import Counter
from time import monotonic

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import (
    GROUND_SYSTEM,
    beat,
    command_long,
    drone_and_ground,
    greet,
    ground_heartbeat,
    heartbeat,
    name_of,
    pack,
    station,
)
from tests.daemon.harness import End, Stage

BUDGET_BITS_S = 4000
BURST_BYTES = 28 + 23 + 280
"""The budget may be drawn on ahead by one largest frame in its envelope, no more."""
UDP_BYTES = 28
SECONDS = 8
OFFERED_PER_S = 300
IN_TIME_S = 1.0
MAX_AGE_S = 1.0
"""What waited longer for its turn is not sent any more: the default of ``max_age_s``."""
ON_THE_WAY_S = 0.2


def telemetry(number: int) -> bytes:
    """One of six messages in turn, of the sizes that autopilots stream."""
    m = mavlink
    messages = (
        m.MAVLink_attitude_message(number, 0.1, 0.2, 0.3, 0.1, 0.2, 0.3),
        m.MAVLink_global_position_int_message(number, 473977420, 85455940, 488000, 3000, 10, 20, 30, 9000),
        m.MAVLink_vfr_hud_message(1.5, 2.5, 180, 40, number, 0.5),
        m.MAVLink_raw_imu_message(number, 1, 2, 3, 4, 5, 6, 7, 8, 9),
        m.MAVLink_statustext_message(6, f"text number {number}".encode()),
        m.MAVLink_battery_status_message(0, 1, 1, 2000, [4000] * 10, 100, number, 0, 80),
    )
    return pack(messages[number % 6], 1, seq=number)


async def test_what_matters_arrives_within_a_second_on_4_kbit_s(stage: Stage) -> None:
    """300 frames/s offered to 4 kbit/s: each heartbeat, command and answer is there within a second, both ways."""
    relay = await stage.relay()
    drone, ground = drone_and_ground(stage, relay, budget_bits_s=BUDGET_BITS_S)
    into_drone, into_ground = drone.add_endpoint("autopilot"), ground.add_endpoint("station")
    on_wire: list[tuple[float, End, int]] = []

    def count(end: End, datagram: bytes) -> None:
        on_wire.append((monotonic(), end, len(datagram) + UDP_BYTES))
        relay.deliver(end, datagram)

    relay.on_datagram = count
    await stage.start(drone, ground)
    autopilot, pilot = await station(stage), await station(stage)
    await greet(drone, "autopilot", autopilot, into_drone, 1)
    await greet(ground, "station", pilot, into_ground, GROUND_SYSTEM)
    await autopilot.until_heard(ground_heartbeat())
    # The greetings are over before the counting begins: the handshake used up some of the budget.
    await ground.until(lambda status: status["peers"]["drone1"]["frames_received"] == 1)
    before = await drone.status()

    sent: dict[bytes, float] = {}
    given_at: dict[bytes, float] = {}
    offered: Counter[str] = Counter()
    asked = Counter[str]()

    def from_autopilot(frame: bytes, *, matters: bool) -> None:
        given_at[frame] = monotonic()
        if matters:
            sent[frame] = given_at[frame]
        offered[name_of(frame)] += 1
        autopilot.send(frame, into_drone)

    def from_pilot(frame: bytes) -> None:
        sent[frame] = monotonic()
        pilot.send(frame, into_ground)

    def stream(number: int) -> None:
        for each in range(OFFERED_PER_S // 50):
            from_autopilot(telemetry(number * OFFERED_PER_S // 50 + each), matters=False)

    def alive(number: int) -> None:
        from_autopilot(heartbeat(1, seq=1 + number), matters=True)
        from_pilot(ground_heartbeat(seq=1 + number))

    def command(number: int) -> None:
        from_pilot(command_long(mavlink.MAV_CMD_DO_SET_SERVO, GROUND_SYSTEM, seq=100 + number, param1=number))

    async def answer() -> None:
        while True:
            await autopilot.until(lambda: names(autopilot.frames)["COMMAND_LONG"] > asked["times"])
            message = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_DO_SET_SERVO, 0, 0, asked["times"])
            from_autopilot(pack(message, 1, seq=200 + asked["times"]), matters=True)
            asked["times"] += 1

    def offered_that_came() -> list[bytes]:
        # The greeting may have come before there was anybody to hear it.
        return [frame for frame in pilot.frames if frame != heartbeat(1)]

    began = monotonic()
    tasks = [asyncio.create_task(work) for work in (beat(stream, 0.02), beat(alive), beat(command, 0.7), answer())]
    await asyncio.wait(tasks, timeout=SECONDS, return_when=asyncio.FIRST_EXCEPTION)
    for task in tasks:
        task.cancel()
    failures = [each for each in await asyncio.gather(*tasks, return_exceptions=True) if isinstance(each, Exception)]
    assert not failures
    ended = monotonic()
    await pilot.until(lambda: all(frame in pilot.frames or frame in autopilot.frames for frame in sent))
    # What waits now is too old in a second, and then it is counted.
    status = await drone.until(
        lambda status: (
            sum(status["peers"]["ground"]["waiting_dropped"].values()) + len(offered_that_came()) == offered.total()
        )
    )

    arrived = {frame: at for at, frame in autopilot.arrivals + pilot.arrivals}
    late = {name_of(frame): arrived[frame] - at for frame, at in sent.items() if arrived[frame] - at > IN_TIME_S}
    assert not late
    assert {"HEARTBEAT", "COMMAND_LONG", "COMMAND_ACK"} <= set(names(list(sent)))
    assert asked["times"] >= SECONDS
    assert len(set(pilot.frames)) == len(pilot.frames), "a frame came twice"

    assert max(at - given_at[frame] for at, frame in pilot.arrivals if frame in given_at) < MAX_AGE_S + ON_THE_WAY_S

    # Thinned, and none starved: each kind of telemetry came again and again, the newest of its kind.
    assert offered.total() > 0.9 * OFFERED_PER_S * SECONDS
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "RAW_IMU", "BATTERY_STATUS", "STATUSTEXT"):
        assert names(pilot.frames)[name] >= SECONDS // 3, f"{name} starved"
    assert status["peers"]["ground"]["waiting_dropped"]["thinned"] > offered.total() // 2

    for end in End:
        spent = sum(size for at, to, size in on_wire if to is end and began <= at <= ended)
        assert spent <= (ended - began) * BUDGET_BITS_S / 8 + BURST_BYTES, f"towards {end}: {spent} bytes"
    towards_ground = [size for at, to, size in on_wire if to is End.B and began <= at]
    told = status["peers"]["ground"]["bytes_sent"] - before["peers"]["ground"]["bytes_sent"]
    assert told <= sum(towards_ground) - UDP_BYTES * len(towards_ground) + 100
    # And it is used: a budget that is kept by sending nothing would be no good.
    assert sum(towards_ground) > 0.8 * (ended - began) * BUDGET_BITS_S / 8


def names(frames: list[bytes]) -> Counter[str]:
    """How many frames there are of each message."""
    return Counter(map(name_of, frames))
