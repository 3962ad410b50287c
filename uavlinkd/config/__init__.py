"""The configuration: a TOML file becomes an immutable :class:`Config`, or a :class:`ConfigError` with every problem.

:func:`uavlinkd.config.load.load_config` is not imported here: it imports pydantic, which the commands for keys do
not need.
"""

from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.model import (
    Config,
    EndpointConfig,
    Log,
    NetworkConfig,
    PeerAddress,
    PeerConfig,
    PolicyData,
    Recording,
    RelayConfig,
    RelayServer,
    Routing,
)
from uavlinkd.mavlink.egress.budgeted import EgressSettings

__all__ = [
    "Config",
    "ConfigError",
    "EgressSettings",
    "EndpointConfig",
    "Log",
    "NetworkConfig",
    "PeerAddress",
    "PeerConfig",
    "PolicyData",
    "Problem",
    "Recording",
    "RelayConfig",
    "RelayServer",
    "Routing",
]
