"""Opens the endpoints of a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from uavlinkd.config import Config, ConfigError, EndpointConfig
from uavlinkd.config.errors import Problem
from uavlinkd.endpoints.ports import Endpoint, PortHandler
from uavlinkd.endpoints.sockets import BindError, udp_socket
from uavlinkd.endpoints.udp import UdpClient, UdpServer
from uavlinkd.endpoints.url import EndpointKind, EndpointUrl, NetworkUrl, SerialUrl

# TCP and serial are imported only if configured: a daemon on UDP starts faster and stays smaller.
# ruff: noqa: PLC0415


def open_new(
    config: Config, wanted: Sequence[EndpointConfig], leaving: Mapping[EndpointUrl, Endpoint], handler: PortHandler
) -> list[Endpoint]:
    """Open endpoints of a new configuration while those that it closes are still open, by their URLs in ``leaving``.

    An endpoint that listens at the same address takes over the socket. So endpoints can be renamed, or swap ports.

    Raises:
        ConfigError: if one cannot be opened. Then none is, and the others are as they were.
    """
    opened: list[Endpoint] = []
    for endpoint_config in wanted:
        try:
            opened.append(open_endpoint(endpoint_config, handler, leaving.get(endpoint_config.url)))
        except (BindError, OSError) as error:
            for endpoint in opened:
                endpoint.close()
            is_taken = isinstance(error, BindError) and error.is_taken
            remedy = "; if it is this daemon, restart it" if is_taken else ""
            problem = Problem(str(config.path), _key(endpoint_config), f"{error}{remedy}")
            raise ConfigError((problem,)) from None
    return opened


def open_first(config: EndpointConfig, handler: PortHandler) -> Endpoint:
    """Open an endpoint of a daemon that starts.

    Raises:
        BindError: if the daemon cannot listen on its address. The message names the key.
    """
    try:
        return open_endpoint(config, handler)
    except BindError as error:
        raise BindError(f"{_key(config)}: {error}") from None


def _key(config: EndpointConfig) -> str:
    return f"endpoint.url ({config.name})"


def open_endpoint(config: EndpointConfig, handler: PortHandler, instead_of: Endpoint | None = None) -> Endpoint:
    """Open the endpoint: a socket that listens is bound. It begins to work when it is started.

    ``instead_of``: an endpoint with the same URL that is about to be closed.

    Raises:
        BindError: if the daemon cannot listen on its address.
    """
    match config.url:
        case NetworkUrl(EndpointKind.UDPIN, address):
            sock = (
                instead_of.share_socket()
                if isinstance(instead_of, UdpServer)
                else udp_socket(address, may_come_later=True)
            )
            return UdpServer(config.name, sock, handler)
        case NetworkUrl(EndpointKind.UDPOUT, address):
            return UdpClient(config.name, address, handler)
        case NetworkUrl(EndpointKind.TCPIN, address):
            from uavlinkd.endpoints.tcp import TcpServer, tcp_listener

            sock = instead_of.share_socket() if isinstance(instead_of, TcpServer) else tcp_listener(address)
            return TcpServer(config.name, sock, handler, max_age_s=config.max_age_s)
        case NetworkUrl(_, address):
            from uavlinkd.endpoints.tcp import TcpClient

            return TcpClient(config.name, address, handler, max_age_s=config.max_age_s)
        case SerialUrl() as url:
            from uavlinkd.endpoints.serial import SerialEndpoint

            return SerialEndpoint(config.name, url, handler, max_age_s=config.max_age_s)
