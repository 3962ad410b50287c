"""The errors of the fleet commands. Each message is for a person and contains no secret."""

from __future__ import annotations

from pathlib import Path


class FleetError(Exception):
    """The command line, the manifest or a configuration is wrong. The command changed nothing."""


class FleetFileError(FleetError):
    """A file or folder cannot be read or written."""


def no_fleet(folder: Path) -> FleetError:
    """The error for a folder without a manifest."""
    return FleetError(
        f"{folder} contains no fleet: name its folder with --out DIR,"
        f" or create one with `uavlinkd fleet init --out {folder}`"
    )
