"""The flooding process sends valid initiations from as many addresses as requested."""

from __future__ import annotations

import io
import socket
from collections.abc import Iterator

import pytest

from uavlinkd.config.keys import encode_key
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.crypto import KeyPair
from uavlinkd.core.limits import source_of
from uavlinkd.lab.evaluation.flooder import flood, host_of, main
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of

KEY = KeyPair(b"\x07" * 32).public


@pytest.fixture
def target() -> Iterator[socket.socket]:
    """Where a daemon would be."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
        yield sock


def arrived(sock: socket.socket) -> list[tuple[bytes, str]]:
    """What waits there, and from which hosts."""
    result: list[tuple[bytes, str]] = []
    while True:
        try:
            datagram, (host, _) = sock.recvfrom(2048)
        except BlockingIOError:
            return result
        result.append((datagram, host))


def test_every_initiation_is_sound_up_to_its_mac1_and_none_is_like_another(target: socket.socket) -> None:
    """They cost the daemon all that a stranger with its public key can make them cost."""
    sent = flood(target.getsockname()[1], KEY, 1000.0, 0.3, 8)
    result = arrived(target)
    assert len(result) == sent
    assert 20 < sent <= 301
    for datagram, _ in result:
        assert kind_of(datagram) is DatagramKind.INITIATION
        MacKeys(KEY).check_mac1(datagram)
    assert len({datagram for datagram, _ in result}) == sent
    assert {source_of(host) for _, host in result} == {host_of(number) for number in range(8)}


def test_it_waits_for_its_line_and_tells_its_number(
    target: socket.socket, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ready, then the flood, then how many."""
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    assert main([str(target.getsockname()[1]), encode_key(KEY), "200", "0.2", "2"]) == 0
    ready, count = capsys.readouterr().out.splitlines()
    assert ready == "ready"
    assert int(count) == len(arrived(target)) > 0
