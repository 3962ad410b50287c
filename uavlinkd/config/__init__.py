"""The configuration: from a TOML file to values that cannot change, or every problem that the file has.

``load_config`` reads a file in this process; ``uavlinkd.config.reader.read_config`` in another one, which spares the
daemon the memory and the time of the checker.
"""

from typing import TYPE_CHECKING, Any

from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.model import Config, Endpoint, Log, Peer, PolicyData, Recording, Routing
from uavlinkd.mavlink.egress.budgeted import EgressSettings

if TYPE_CHECKING:
    from uavlinkd.config.load import load_config

__all__ = [
    "Config",
    "ConfigError",
    "EgressSettings",
    "Endpoint",
    "Log",
    "Peer",
    "PolicyData",
    "Problem",
    "Recording",
    "Routing",
    "load_config",
]


def __getattr__(name: str) -> Any:
    """``load_config`` brings pydantic with it, 12 MB of it: only where it is asked for (PEP 562)."""
    if name == "load_config":
        from uavlinkd.config.load import load_config  # noqa: PLC0415

        return load_config
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
