"""Tags of the paper's method and of its protocol; the quick runs of evaluations show their exchanges."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation import paper, paper_protocol
from uavlinkd.lab.evaluation.ledger import numbered_frame

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


def test_an_altered_tag_does_not_verify(ends: tuple[socket.socket, socket.socket]) -> None:
    reported: dict[str, Any] = {}
    responder = threading.Thread(target=lambda: reported.update(paper.respond(ends[1])))
    responder.start()
    key = paper.GroupKey(paper.load_parameters(ffdhe_prime(2048)))
    ends[0].send(paper._pack(ffdhe_prime(2048), key.public))
    ends[0].recv(65536)
    ends[0].send(b"data" + bytes(paper.TAG_BYTES))
    responder.join()
    assert reported["verified"] is False


def test_data_is_opened_under_its_key_alone() -> None:
    frame = numbered_frame(1, 7)
    for number in (0, 2**16 - 1, 2**16, 2**20):
        datagram = paper_protocol.seal(b"k" * 32, number, frame)
        assert paper_protocol.unseal(b"k" * 32, datagram) == frame
        assert paper_protocol.unseal(b"j" * 32, datagram) is None
        for at in range(len(datagram)):
            altered = datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]
            assert paper_protocol.unseal(b"k" * 32, altered) is None
