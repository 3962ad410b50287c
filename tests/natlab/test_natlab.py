"""The laboratory itself: each kind of router maps, filters and forgets as its name says, and nothing remains."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from time import monotonic

import pytest

from tests import namespaces
from tests.natlab.behaviour import Behaviour, Reflector, hairpins
from tests.natlab.kinds import ADDRESS, INDEPENDENT, PORT
from tests.natlab.laboratory import Laboratory, need_laboratory
from tests.waiting import PATIENCE_S

BEHAVIOURS = {
    "open": Behaviour(INDEPENDENT, INDEPENDENT, keeps_port=True),
    "firewall": Behaviour(INDEPENDENT, PORT, keeps_port=True),
    "full-cone": Behaviour(INDEPENDENT, INDEPENDENT, keeps_port=False),
    "full-cone-hairpin": Behaviour(INDEPENDENT, INDEPENDENT, keeps_port=False),
    "address-restricted": Behaviour(INDEPENDENT, ADDRESS, keeps_port=False),
    "port-restricted": Behaviour(INDEPENDENT, PORT, keeps_port=False),
    "port-restricted-hairpin": Behaviour(INDEPENDENT, PORT, keeps_port=False),
    "address-dependent": Behaviour(ADDRESS, ADDRESS, keeps_port=False),
    "symmetric": Behaviour(PORT, PORT, keeps_port=False),
    "symmetric-hairpin": Behaviour(PORT, PORT, keeps_port=False),
    "linux": Behaviour(INDEPENDENT, PORT, keeps_port=True),
    "linux-random": Behaviour(PORT, PORT, keeps_port=False),
    "carrier": Behaviour(INDEPENDENT, PORT, keeps_port=False),
    "carrier-hairpin": Behaviour(INDEPENDENT, PORT, keeps_port=False),
    "carrier-symmetric": Behaviour(PORT, PORT, keeps_port=False),
}


@pytest.fixture(scope="module")
def laboratory() -> Iterator[Laboratory]:
    need_laboratory()
    with Laboratory() as laboratory:
        yield laboratory


@pytest.fixture
def reflector(laboratory: Laboratory) -> Iterator[Reflector]:
    with closing(Reflector(laboratory)) as reflector:
        yield reflector


@pytest.mark.parametrize("kind", BEHAVIOURS)
def test_kind_maps_and_filters_as_it_says(kind: str, laboratory: Laboratory, reflector: Reflector) -> None:
    """Measured from both sides. The host does not know its external address."""
    place = laboratory.place(kind)

    assert reflector.behaviour(place) == BEHAVIOURS[kind]

    with place.host.udp_socket(timeout_s=PATIENCE_S) as inner:
        assert reflector.seen(inner)[0] == place.external


def test_only_udp_is_blocked(laboratory: Laboratory, reflector: Reflector) -> None:
    """A datagram sent before a connection has not arrived when the connection is made."""
    place = laboratory.place("no-udp")
    address, port = reflector.addresses[0]
    with reflector.host.entered():
        server = socket.create_server((address, port))
    with place.host.entered():
        client = socket.socket()
    client.settimeout(PATIENCE_S)

    with place.host.udp_socket() as inner, server, client:
        inner.sendto(b"blocked", (address, port))
        client.connect((address, port))

    reflector.sockets[0].setblocking(False)
    with pytest.raises(BlockingIOError):
        reflector.sockets[0].recv(64)


@pytest.mark.parametrize(
    ("kind", "passes"),
    [
        ("full-cone", False),
        ("full-cone-hairpin", True),
        ("port-restricted", False),
        ("port-restricted-hairpin", True),
        ("symmetric-hairpin", False),  # the router hairpins, from a port that its filter refuses
    ],
)
def test_hosts_in_one_home(kind: str, passes: bool, laboratory: Laboratory, reflector: Reflector) -> None:
    """At their external addresses only a router that hairpins connects them. At their own ones they meet at home."""
    place = laboratory.place(kind)
    mate = place.housemate()

    assert hairpins(place, mate, reflector) is passes

    with place.host.udp_socket() as one, mate.host.udp_socket(timeout_s=PATIENCE_S) as other:
        one.sendto(b"at home", (mate.address, other.getsockname()[1]))
        assert other.recv(64) == b"at home"


@pytest.mark.parametrize(("kind", "passes"), [("carrier", False), ("carrier-hairpin", True)])
def test_homes_of_one_carrier(kind: str, passes: bool, laboratory: Laboratory, reflector: Reflector) -> None:
    """Two routers in a row each, the outer one shared: both homes have the same external address."""
    place = laboratory.place(kind)
    neighbour = place.neighbour()

    assert place.external == neighbour.external
    assert hairpins(place, neighbour, reflector) is passes


@pytest.mark.parametrize("kind", ["firewall", "full-cone", "linux", "linux-random", "carrier"])
def test_unsolicited_datagrams_are_dropped_silently(kind: str, laboratory: Laboratory, reflector: Reflector) -> None:
    """No error reaches their sender, and they take no mapping from the host that uses the same port later."""
    place = laboratory.place(kind)
    with (
        place.host.udp_socket(timeout_s=PATIENCE_S) as inner,
        place.host.udp_socket(timeout_s=PATIENCE_S) as other,
        reflector.host.udp_socket(timeout_s=PATIENCE_S) as stranger,
    ):
        stranger.connect((place.external, inner.getsockname()[1]))
        stranger.send(b"unsolicited")
        assert reflector.passes(other, reflector.seen(other), 0) == {0}
        inner.sendto(b"solicited", stranger.getsockname())

        assert reflector.passes(inner, reflector.seen(inner), 0) == {0}
        assert stranger.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0
        if BEHAVIOURS[kind].keeps_port:
            assert stranger.recv(64) == b"solicited"  # from the port to which the unsolicited one went


@pytest.mark.parametrize("kind", ["firewall", "symmetric", "carrier", "linux"])
def test_only_answers_come_in_over_ipv6(kind: str, laboratory: Laboratory) -> None:
    """The address stays as it is."""
    place, public = laboratory.place(kind, has_ipv6=True), laboratory.public(has_ipv6=True)
    with (
        place.host.udp_socket(place.ipv6, timeout_s=PATIENCE_S) as inner,
        public.host.udp_socket(public.ipv6) as stranger,
        public.host.udp_socket(public.ipv6, timeout_s=PATIENCE_S) as server,
    ):
        stranger.sendto(b"unsolicited", inner.getsockname())
        inner.sendto(b"question", server.getsockname())
        source = server.recvfrom(64)[1]
        assert source == inner.getsockname()
        server.sendto(b"answer", source)
        assert inner.recv(64) == b"answer"


@pytest.mark.parametrize("kind", ["full-cone", "port-restricted", "symmetric", "carrier", "linux"])
def test_forgotten_mapping_is_gone(kind: str, laboratory: Laboratory, reflector: Reflector) -> None:
    """The next datagram gets another port, but from a router that keeps ports: there the old one is valid again."""
    place = laboratory.place(kind)
    with place.host.udp_socket(timeout_s=PATIENCE_S) as inner:
        before = reflector.seen(inner)
        place.forget()
        reflector.sockets[0].sendto(b"forgotten", before)
        after = reflector.seen(inner)

        assert (after == before) is BEHAVIOURS[kind].keeps_port
        assert reflector.passes(inner, after, 0) == {0}


def test_line_delays_and_loses(laboratory: Laboratory, reflector: Reflector) -> None:
    """By at least that time. On average 30 of 150 are lost; the limits are five standard deviations away."""
    delay_s, loss, count = 0.05, 0.2, 150
    place = laboratory.place("port-restricted", delay_s=delay_s, loss=loss)
    with place.host.udp_socket(timeout_s=PATIENCE_S) as inner:
        began = monotonic()
        for _ in range(count):
            inner.sendto(b"counted", reflector.addresses[0])
        for _ in range(30):
            inner.sendto(b"last", reflector.addresses[0])
        arrived = list(iter(lambda: reflector.sockets[0].recv(64), b"last"))
        delayed_s = monotonic() - began

    assert delayed_s >= delay_s
    assert 5 < count - len(arrived) < 55


def ours(pid: int) -> list[str]:
    return [path.name for path in Path("/run/netns").glob(f"uavns-{pid}-*")]


def test_nothing_remains(laboratory: Laboratory) -> None:
    """Neither namespaces nor processes in them, also if the block fails."""
    before = set(ours(os.getpid()))

    def fail() -> None:
        with Laboratory() as other:
            command = [*other.place("carrier").host.launcher, "sh", "-c", "echo here; exec sleep infinity"]
            processes.append(subprocess.Popen(command, stdout=subprocess.PIPE))
            assert processes[0].stdout is not None
            assert processes[0].stdout.readline() == b"here\n"  # it has entered the namespace
            raise ZeroDivisionError

    processes: list[subprocess.Popen[bytes]] = []
    with pytest.raises(ZeroDivisionError):
        fail()

    with processes[0] as process:
        assert process.wait(PATIENCE_S) == -signal.SIGKILL
    assert set(ours(os.getpid())) == before


def test_killed_laboratory_is_removed_by_the_next(laboratory: Laboratory) -> None:
    killed = subprocess.run(
        [
            *(sys.executable, "-c"),
            "import os; from tests.natlab.laboratory import Laboratory\n"
            "with Laboratory() as laboratory:\n"
            "    laboratory.place('full-cone')\n    print(os.getpid(), flush=True); os.kill(os.getpid(), 9)",
        ],
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        check=False,
    )
    pid = int(killed.stdout)
    assert killed.returncode == -signal.SIGKILL
    assert ours(pid)

    namespaces.remove_leftovers()

    assert not ours(pid)
