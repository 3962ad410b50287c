"""The launcher of real autopilots: its environment variables, and a process that does not start."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.sitl.real_autopilot import (
    Firmware,
    RealAutopilot,
    RealAutopilotError,
    RealAutopilotSettings,
    binary_of,
)
from uavlinkd.lab.sim.autopilot import HOME


@pytest.mark.parametrize("firmware", Firmware)
def test_environment_names_the_binary(firmware: Firmware, tmp_path: Path) -> None:
    """Unset or empty means none; a file that cannot be executed is an error that names the variable."""
    variable = f"UAVLINKD_{firmware.value.upper()}"
    binary = tmp_path / "autopilot"
    binary.write_text("#!/bin/sh\n")

    assert binary_of(firmware, {}) is None
    assert binary_of(firmware, {variable: ""}) is None
    for wrong in (binary, tmp_path, tmp_path / "missing"):
        with pytest.raises(RealAutopilotError, match=variable):
            binary_of(firmware, {variable: str(wrong)})
    binary.chmod(0o700)
    assert binary_of(firmware, {variable: str(binary)}) == binary.resolve()


def build_folder(folder: Path, commands: str = "") -> Path:
    """A folder like a build of PX4. Returns its binary, which runs these commands."""
    binary, script = folder / "bin" / "px4", folder / "etc" / "init.d-posix" / "rcS"
    for path in (binary, script):
        path.parent.mkdir(parents=True)
    binary.write_text(f"#!/bin/sh\n{commands}")
    binary.chmod(0o700)
    script.write_text("param set MAV_SYS_ID $((px4_instance+1))\n")
    (binary.parent / "px4-mavlink").touch()
    return binary


@pytest.mark.parametrize("firmware", Firmware)
async def test_process_that_ends_is_reported_with_its_output(firmware: Firmware, tmp_path: Path) -> None:
    """The error has the exit status and the last lines. ArduCopter's end shows at the first check."""
    binary = build_folder(tmp_path, "echo no such model\nexit 3\n")
    settings = RealAutopilotSettings(firmware=firmware, binary=binary, udp_port=14550, home=HOME)
    autopilot = RealAutopilot(settings, tmp_path / "flight")
    with pytest.raises(RealAutopilotError, match=r"status 3:\nno such model"):
        await run_until_failure(autopilot)


async def run_until_failure(autopilot: RealAutopilot) -> None:
    """Start it, and check it until that raises."""
    async with autopilot:
        while True:
            autopilot.check()
            await asyncio.sleep(0.01)
