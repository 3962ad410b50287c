"""A ground station by pymavlink as a process: arm, all parameters, a mission of 100 items up and down.

``python -m tests.stations.ground_station PORT`` listens at a UDP port, as QGroundControl does, and prints a line of
JSON with what it saw and how long each step took.
"""

from __future__ import annotations

import json
import os
import sys
from time import monotonic
from typing import Any

ITEMS = 100
TRIES = 60
"""A request is repeated after each second without its answer, as every ground station does."""


def main(port: int) -> None:
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    link: Any = mavutil.mavlink_connection(f"udpin:0.0.0.0:{port}", source_system=255, dialect="ardupilotmega")

    def wait(kind: str, send: Any, *, fits: Any = lambda message: True) -> Any:
        """The answer to a request."""
        for _ in range(TRIES):
            link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4)
            send()
            until = monotonic() + 1.0
            while (left_s := until - monotonic()) > 0:
                message = link.recv_match(type=kind, blocking=True, timeout=left_s)
                if message is not None and fits(message):
                    return message
        raise SystemExit(f"no {kind} came")

    link.wait_heartbeat(timeout=TRIES)
    times = [monotonic()]
    target = link.target_system, link.target_component
    parameters: dict[int, tuple[str, float]] = {}

    def note(message: Any) -> bool:
        parameters[message.param_index] = message.param_id, message.param_value
        return len(parameters) == int(message.param_count)

    wait("PARAM_VALUE", lambda: link.mav.param_request_list_send(*target), fits=note)
    times.append(monotonic())
    plan = [(0, 16, 473977420, 85455940, 488.0)]
    plan += [(3, 16, 473977420 + 100 * n, 85455940, 10.0 + n) for n in range(1, ITEMS)]

    def item(sequence: int) -> None:
        frame, command, x, y, z = plan[sequence]
        link.mav.mission_item_int_send(*target, sequence, frame, command, 0, 1, 0.0, 0.0, 0.0, 0.0, x, y, z)

    def upload(sequence: int) -> Any:
        """Send an item; returns the request of the next one, or the acknowledgement of all."""
        kind = "MISSION_REQUEST_INT" if sequence < ITEMS - 1 else "MISSION_ACK"
        return wait(kind, lambda: item(sequence), fits=lambda answer: getattr(answer, "seq", ITEMS) > sequence)

    def download(sequence: int) -> tuple[Any, ...]:
        """Request an item."""
        request = lambda: link.mav.mission_request_int_send(*target, sequence)  # noqa: E731
        got = wait("MISSION_ITEM_INT", request, fits=lambda answer: answer.seq == sequence)
        return got.frame, got.command, got.x, got.y, got.z

    wait("MISSION_REQUEST_INT", lambda: link.mav.mission_count_send(*target, ITEMS))
    answers = [upload(sequence) for sequence in range(ITEMS)]
    assert answers[-1].type == mavlink.MAV_MISSION_ACCEPTED
    times.append(monotonic())
    counted = wait("MISSION_COUNT", lambda: link.mav.mission_request_list_send(*target))
    back = [download(sequence) for sequence in range(counted.count)]
    link.mav.mission_ack_send(*target, mavlink.MAV_MISSION_ACCEPTED)
    times.append(monotonic())
    armed = wait("COMMAND_ACK", lambda: link.mav.command_long_send(*target, 400, 0, 1.0, 0, 0, 0, 0, 0, 0))
    assert armed.result == mavlink.MAV_RESULT_ACCEPTED, armed.result
    wait("HEARTBEAT", lambda: None, fits=lambda beat: beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    times.append(monotonic())
    names = ("parameters_s", "mission_up_s", "mission_down_s", "arm_s")
    took = {name: round(end - begin, 3) for name, begin, end in zip(names, times, times[1:], strict=False)}
    print(json.dumps({**took, "parameters": len(parameters), "same_plan": back == plan, "items": len(back)}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
