"""``python -m tests.sitl.roles``: frames that roles pass, to autopilots on the ground and in the air.

The environment names the autopilots' binaries: ``UAVLINKD_ARDUPILOT``, ``UAVLINKD_PX4``. Exit status 0: no frame
changed an autopilot. 1: one did, or datagrams were lost. 2: invalid command line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from tests.sitl.roles_frames import ROLES_TESTED
from tests.sitl.roles_scene import MakeVehicle, SceneResult, run_scene
from tests.sitl.roles_vehicles import ArduCopter, Px4, SimulatedVehicle
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilotError, binary_of

OK, FAILED = 0, 1
PLACES: Final = {"ground": False, "air": True}


def available() -> dict[str, MakeVehicle]:
    """The autopilots that this machine has, by name.

    Raises:
        RealAutopilotError: a variable names a file that cannot be executed.
    """
    makers: dict[str, MakeVehicle] = {"sim": SimulatedVehicle}
    if ardupilot := binary_of(Firmware.ARDUPILOT):
        makers["ardupilot"] = lambda folder: ArduCopter(folder, ardupilot)
    if px4 := binary_of(Firmware.PX4):
        makers["px4"] = lambda folder: Px4(folder, px4)
    return makers


def lines(name: str, result: SceneResult) -> list[str]:
    """The result of one scene for people."""
    rows = [
        f"{name}, {result.title}: {result.frames:,} frames in {result.seconds:.0f} s of its time, "
        f"{result.lost} datagrams lost, {result.repeated_barriers} barriers repeated",
        f"  by message: {', '.join(f'{message} {count:,}' for message, count in sorted(result.by_message.items()))}",
        f"  {result.parameters:,} parameters; farthest from its place {result.farthest_m:.2f} m",
        f"  changed in quiet too: {', '.join((*result.changed_by_itself, *result.changed_in_quiet)) or '-'}",
        f"  sent to the attacker: {', '.join(f'{m} {n:,}' for m, n in result.answers.most_common(25))}",
        *(f"  text {count:,} times: {text}" for text, count in result.texts.most_common(25)),
        *(f"  CHANGED {change}" for change in result.changes),
        *(f"  by {culprit.hex(' ')}" for culprit in result.culprits[:20]),
    ]
    return rows if result.changes else [*rows, "  nothing else changed"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the scenes of the command line, and print each result."""
    parser = argparse.ArgumentParser(prog="python -m tests.sitl.roles", description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000, help="for each autopilot, over all scenes (1000000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--autopilot", action="append", choices=("sim", "ardupilot", "px4"), help="all but sim")
    options = parser.parse_args(arguments)
    try:
        makers = available()
    except RealAutopilotError as error:
        parser.error(str(error))
    names = options.autopilot or [name for name in makers if name != "sim"]
    missing = [name for name in names if name not in makers]
    if missing or not names:
        parser.error(f"no binary for {', '.join(missing) or 'any autopilot'}: set UAVLINKD_ARDUPILOT or UAVLINKD_PX4")
    scenes = [(role, place) for role in ROLES_TESTED for place in PLACES]
    share = -(-options.frames // len(scenes))
    is_ok = True
    for name in names:
        for number, (role, place) in enumerate(scenes):
            result = run_scene(makers[name], role, share, options.seed + number, is_flying=PLACES[place], write=_say)
            print("\n".join(lines(name, result)), flush=True)
            is_ok = is_ok and not result.changes and not result.lost
    return OK if is_ok else FAILED


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
