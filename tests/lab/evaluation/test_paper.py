"""The paper's method, both ends of it."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.waiting import PATIENCE_S
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


def exchange(
    ends: tuple[socket.socket, socket.socket], bits: int, mac_bits: int, *, standard: bool = False
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run one; what each end tells."""
    reported: dict[str, Any] = {}
    responder = threading.Thread(target=lambda: reported.update(paper.respond(ends[1])))
    responder.start()
    initiated = paper.initiate(ends[0], bits, mac_bits, b"data" * 70, standard=standard)
    responder.join()
    return initiated, reported


@pytest.mark.parametrize(("bits", "standard"), [(64, False), (256, False), (512, False), (2048, True)])
@pytest.mark.parametrize("mac_bits", [512, 2048])
def test_both_ends_reach_the_same_key(
    ends: tuple[socket.socket, socket.socket], bits: int, standard: bool, mac_bits: int
) -> None:
    """The tag verifies, for groups made here, made by OpenSSL, and standard ones."""
    initiated, reported = exchange(ends, bits, mac_bits, standard=standard)
    assert reported["verified"] is True
    assert reported["verified_at"] > initiated["started_at"]
    assert initiated["datagrams"] == 3


def test_an_altered_tag_does_not_verify(ends: tuple[socket.socket, socket.socket]) -> None:
    """The responder does compare."""
    reported: dict[str, Any] = {}
    responder = threading.Thread(target=lambda: reported.update(paper.respond(ends[1])))
    responder.start()
    key = paper.make_key(paper.load_parameters(ffdhe_prime(2048)))
    ends[0].send(paper._pack(ffdhe_prime(2048), 512, key.public))
    ends[0].recv(65536)
    ends[0].send(b"data" + bytes(paper.TAG_BYTES))
    responder.join()
    assert reported["verified"] is False


def test_a_standard_group_is_the_published_one() -> None:
    """The group is not generated."""
    assert paper.prime_of(paper.make_parameters(2048, standard=True)) == ffdhe_prime(2048)


def test_made_parameters_differ_each_time() -> None:
    """A new prime for every exchange, which is what the paper's method pays for."""
    assert len({paper.prime_of(paper.make_parameters(512, standard=False)) for _ in range(3)}) == 3


def test_a_mac_key_has_the_length_asked_for() -> None:
    """In bits, for any length of the secret."""
    assert [len(paper.mac_key(b"secret", bits)) for bits in (512, 1024, 2048)] == [64, 128, 256]


def test_integers_on_the_wire_come_back() -> None:
    """Zero and a number of the largest group."""
    numbers = [0, 1, 255, 256, 1 << 4095]
    assert paper._unpack(paper._pack(*numbers)) == numbers


def test_an_end_ends_with_its_input() -> None:
    """The process ends with its parent."""
    done = subprocess.run(
        [sys.executable, "-m", "uavlinkd.lab.evaluation.paper", "responder"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=PATIENCE_S,
        check=True,
    )
    assert done.stdout.startswith(b'{"port"')
    assert done.stderr == b""
