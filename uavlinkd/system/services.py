"""The services of this machine by their configurations, as in systemd/README.md."""

from __future__ import annotations

from pathlib import Path
from typing import Final

FOLDER: Final = Path("/etc/uavlinkd")
_OWN_UNITS: Final = {"uavlinkd": "uavlinkd", "relay": "uavlinkd-relay"}


def unit_of(config: Path) -> str:
    """The unit that runs a configuration: `uavlinkd@v7` of /etc/uavlinkd/v7.toml. Empty for a file elsewhere."""
    is_of_service = config.absolute().parent == FOLDER
    return _OWN_UNITS.get(config.stem, f"uavlinkd@{config.stem}") if is_of_service else ""


def units() -> list[str]:
    """The units that have a configuration."""
    return [unit_of(path) for path in sorted(FOLDER.glob("*.toml"))]
