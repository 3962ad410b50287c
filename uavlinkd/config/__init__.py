"""The configuration: a TOML file becomes an immutable :class:`Config`, or a :class:`ConfigError` with every problem.

:func:`uavlinkd.config.load.load_config` is not imported here: it imports pydantic, which the commands for keys do
not need.
"""

from uavlinkd.config.model import (
    Config,
    ConfigError,
    EndpointConfig,
    Log,
    NetworkConfig,
    PeerAddress,
    PeerConfig,
    PolicyData,
    Problem,
    Recording,
    RelayConfig,
    RelayServer,
    Routing,
)

__all__ = [
    "Config",
    "ConfigError",
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
