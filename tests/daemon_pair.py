"""Two daemons for one process: their configurations, with one client and one peer each, and frames to carry."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.config.model import Config, EndpointConfig, Log, PeerAddress, PeerConfig
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.io.url import NetworkUrl
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.system.addresses import Address

ANY_PORT: Final = Address("127.0.0.1", 0)
PRIVATE: Final = {"left": bytes([1]) * 32, "right": bytes([2]) * 32}
_OTHER: Final = {"left": "right", "right": "left"}
_RULES: Final[dict[str, dict[str, Any]]] = {
    "left": {"role": "vehicle", "system_ids": [1]},
    "right": {"role": "operator", "system_ids": [255]},
}
"""What each may send, as the other one has it in its file."""


def config(name: str, url: NetworkUrl, addresses: tuple[Address, ...] = ()) -> Config:
    """The daemon ``left`` or ``right``, with a client at this URL, on a port that the kernel chooses.

    ``addresses``: of the other one, if this one connects.
    """
    other = _OTHER[name]
    settings = PeerSettings(other, KeyPair(PRIVATE[other]).public, None, Link())
    return Config(
        path=Path(name),
        name=name,
        private_key=Secret(PRIVATE[name]),
        public_key=KeyPair(PRIVATE[name]).public,
        listen=(ANY_PORT,),
        endpoints=(EndpointConfig("client", url),),
        peers=(PeerConfig(settings, tuple(map(PeerAddress, addresses)), _RULES[other]),),
        relays_frames=False,
        control_socket=None,
        log=Log("info", "json"),
        warnings=(),
    )


def are_linked(left: Daemon, right: Daemon) -> bool:
    """Whether each of the daemons knows that the other one is there."""
    return left.parts.links["right"].peer.is_up and right.parts.links["left"].peer.is_up


def attitude(number: int) -> bytes:
    """A frame of 40 bytes that differs from that of every other number."""
    codec = mavlink.MAVLink(None, 1, 1)
    codec.seq = number % 256
    return bytes(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1).pack(codec))
