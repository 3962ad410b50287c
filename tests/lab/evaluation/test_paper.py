"""The paper's method, both ends of it, and the groups that OpenSSL does not make."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation import paper
from uavlinkd.lab.evaluation.paper import generate_safe_prime, is_probable_prime

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


@pytest.mark.parametrize(("bits", "standard"), [(64, False), (256, False), (512, False), (2048, True)])
@pytest.mark.parametrize("mac_bits", [512, 2048])
def test_both_ends_reach_the_same_key(
    ends: tuple[socket.socket, socket.socket], bits: int, standard: bool, mac_bits: int
) -> None:
    """The tag verifies, for groups made here, made by OpenSSL, and standard ones."""
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
    key = paper.make_key(paper.load_parameters(ffdhe_prime(2048)))
    ends[0].send(paper._pack(ffdhe_prime(2048), 512, key.public))
    ends[0].recv(65536)
    ends[0].send(b"data" + bytes(paper.TAG_BYTES))
    responder.join()
    assert reported["verified"] is False


def test_composites_are_not_primes() -> None:
    """Small numbers as by trial division; Carmichael numbers; RFC 7919's prime, half of it, and its neighbour."""
    for number in range(5000):
        is_prime = number > 1 and all(number % divisor for divisor in range(2, int(number**0.5) + 1))
        assert is_probable_prime(number) == is_prime, number
    for liar in (561, 41041, 825265, 3215031751, 3825123056546413051, 443372888629441):
        assert not is_probable_prime(liar)
    prime = ffdhe_prime(2048)
    assert is_probable_prime(prime)
    assert is_probable_prime(prime // 2)
    assert not is_probable_prime(prime + 2)
    assert not is_probable_prime(prime * (prime - 2))


@pytest.mark.parametrize("bits", [16, 17, 64, 256])
def test_a_safe_prime_has_its_length_and_2_generates_its_large_subgroup(bits: int) -> None:
    """p and (p-1)/2 are prime, and 2 has the order (p-1)/2."""
    prime = generate_safe_prime(bits)
    assert prime.bit_length() == bits
    assert is_probable_prime(prime)
    assert is_probable_prime(prime // 2)
    assert pow(2, prime // 2, prime) == 1
    with pytest.raises(ValueError, match="at least 16 bits"):
        generate_safe_prime(8)
