"""The paper's method, both ends of it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation import paper

pytestmark = pytest.mark.filterwarnings("ignore:Diffie-Hellman over finite fields")


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connected socket for the initiator, and one for the responder."""
    with socket.socket(type=socket.SOCK_DGRAM) as initiator, socket.socket(type=socket.SOCK_DGRAM) as responder:
        responder.bind(("127.0.0.1", 0))
        initiator.connect(responder.getsockname())
        for sock in (initiator, responder):
            sock.settimeout(240)
        yield initiator, responder


@pytest.mark.parametrize(("bits", "standard"), [(512, False), (2048, True)])
@pytest.mark.parametrize("mac_bits", [512, 2048])
def test_both_ends_reach_the_same_key(
    ends: tuple[socket.socket, socket.socket], bits: int, standard: bool, mac_bits: int
) -> None:
    """The tag verifies, for groups that OpenSSL made, and standard ones."""
    reported: dict[str, Any] = {}
    responder = threading.Thread(target=lambda: reported.update(paper.respond(ends[1])))
    responder.start()
    initiated = paper.initiate(ends[0], bits, mac_bits, b"data" * 70, standard=standard)
    responder.join()
    assert reported["verified"] is True
    assert reported["verified_at"] > initiated["started_at"] + initiated["parameters_s"]


def test_an_altered_tag_does_not_verify(ends: tuple[socket.socket, socket.socket]) -> None:
    reported: dict[str, Any] = {}
    responder = threading.Thread(target=lambda: reported.update(paper.respond(ends[1])))
    responder.start()
    key = paper.GroupKey(paper.load_parameters(ffdhe_prime(2048)))
    ends[0].send(paper._pack(ffdhe_prime(2048), 512, key.public))
    ends[0].recv(65536)
    ends[0].send(b"data" + bytes(paper.TAG_BYTES))
    responder.join()
    assert reported["verified"] is False
