"""The endpoints that several test modules use."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from tests.io.clients import Recorder
from tests.io.stream_pair import Pair
from uavlinkd.io.tcp import TcpServer, tcp_listener
from uavlinkd.system.addresses import Address


@pytest.fixture
async def server() -> AsyncIterator[TcpServer]:
    """Listening, not yet started: a test may call ``on_acceptable`` at times of its own."""
    endpoint = TcpServer("server", tcp_listener(Address("127.0.0.1", 0)), Recorder())
    yield endpoint
    endpoint.close()


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    """Open, with its ``handler`` a Recorder."""
    endpoint = Pair(Recorder())
    endpoint.start()
    yield endpoint
    endpoint.close()
    endpoint.other.close()
