"""What was held back along a learned path still arrives after the path went down: it is late, not replayed."""

from __future__ import annotations

import pytest

from tests.core.radios import Radios
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.settings import Class

HELD_S = 10.0


def held(radios: Radios) -> Radios:
    """Bravo has learned its paths. The second radio holds everything for ten seconds, then delivers it."""
    radios.run(3.0, 0.1, radios.sender(radios.a, Class.CRITICAL))
    radios.radios[1].hold_until = radios.now + HELD_S
    return radios.run(HELD_S + 2.0, 0.1, radios.sender(radios.a, Class.CRITICAL))


def test_held_copies_along_a_learned_path_are_late() -> None:
    """A ground station that learned the paths of a vehicle gets no warning of an attack after a stall."""
    radios = held(Radios())
    drops = radios.b.peer.traffic.drops
    assert drops[DropReason.LATE_COPY] > HELD_S / 0.1 / 2
    assert drops[DropReason.REPLAYED] == 0


def test_a_replay_from_elsewhere_is_a_replay() -> None:
    """A copy from an address where the peer never was is reported."""
    radios = Radios().run(3.0, 0.1)
    radios.send(radios.a, Class.CRITICAL)
    datagram = radios.sent[-1].datagram
    radios.run(5.0, 0.1, radios.sender(radios.a, Class.CRITICAL))
    stranger = radios.sent[-1].path._replace(address=("198.51.100.9", 4000))
    (dropped,) = radios.b.node.receive(datagram, stranger, radios.now)
    assert isinstance(dropped, Dropped)
    assert dropped.reason is DropReason.REPLAYED


@pytest.mark.parametrize(("after_s", "counts"), [(c.FORMER_PATH_S - 10.0, True), (c.FORMER_PATH_S + 10.0, False)])
def test_a_path_that_went_down_counts_for_half_a_minute(after_s: float, counts: bool) -> None:
    """Later a repeat from there is a replay again."""
    radios = Radios().run(3.0, 0.1)
    state = radios.state(radios.b, 1)
    radios.radios[1].is_dead = True
    radios.run(5.0, 0.1, radios.sender(radios.a, Class.CRITICAL), radios.sender(radios.b))
    assert radios.b.peer.paths.find(state.path) is None
    assert radios.b.peer.paths.was_validated(state.path, radios.now + after_s) is counts


def test_the_limit_of_a_path_of_an_idle_link_needs_few_long_probes() -> None:
    """Each test of a length comes with a short question, so the silence after it says something."""
    radios = Radios()
    radios.radios[1].loses = lambda datagram: len(datagram) > 600
    radios.run(40.0)
    tests = [sent for sent in radios.envelopes(radios.a, 0.0) if len(sent.datagram) > 600 and sent.path.socket == 1]
    assert radios.state(radios.a, 1).envelope_limit.limit == c.SMALLER_LIMITS[0]
    assert len(tests) == c.LIMIT_TESTS
