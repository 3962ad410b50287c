"""Serial networks beside the UDP sockets: their paths, their budgets, what the status and the findings say."""

from __future__ import annotations

from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog

from tests.endpoints.test_line_framing import report
from tests.link.socket_states import SocketStateLog
from uavlinkd.config.model import NetworkConfig
from uavlinkd.endpoints.serial_line import SerialLine
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.link.serial_networks import (
    LATER_S,
    LEAST_BITS_S,
    LEAST_SHARE,
    NOISE_PIECES,
    SHORTEST_OF_S,
    UNANSWERED,
    LineRate,
    SerialNetworks,
)
from uavlinkd.link.signs import line_noise
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

NUMBER = 3
BITS_S = 9_600


@pytest.fixture
def states() -> SocketStateLog:
    """What the core gets."""
    return SocketStateLog()


@pytest.fixture
def serial(tmp_path: FilePath, states: SocketStateLog) -> SerialNetworks:
    """One network whose device is absent. In a running event loop."""
    line = SerialUrl(str(tmp_path / "absent"), 57600)
    sik = NetworkConfig("sik", budget_bits_s=BITS_S, serial=line, air_bits_s=24_000)
    stall = StallWatch(monotonic(), lambda pause_s: None)
    return SerialNetworks([sik], NUMBER, states, stall, structlog.get_logger())


async def test_change_is_due_at_once(
    serial: SerialNetworks, states: SocketStateLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon sets its timer after the core knows: else the first try waits for the housekeeping, up to 1 s."""
    known = list[list[tuple[int, bool]]]()
    monkeypatch.setattr(SerialLine, "start", lambda line: None)
    serial.start(lambda *read: None, lambda: known.append(list(states.states)))
    (network,), is_open = serial.networks, [False]
    monkeypatch.setattr(SerialLine, "is_open", property(lambda line: is_open[0]))
    for is_open[0] in (True, False):
        network.report_state(is_change=True)
    assert known == [[(NUMBER, True)], [(NUMBER, True), (NUMBER, False)]]


async def test_late_answers_lower_the_budget_of_the_network(serial: SerialNetworks) -> None:
    """Both that of the frames and that of their copies. An answer counts once."""
    now = monotonic()
    budgets = serial.budgets(now)
    assert budgets[NUMBER].all.rate == BITS_S / 8
    assert budgets[NUMBER].all.burst == pytest.approx(300, abs=5)
    state = SimpleNamespace(path=serial.path_to("sik"), round_trip_s=0.2, answered_at=now, is_off=False)
    requests = SimpleNamespace(was_late=False, unanswered=0)
    paths = SimpleNamespace(states=[state], best=state)
    links = cast(Any, [SimpleNamespace(peer=SimpleNamespace(paths=paths, echo_requests=requests))])
    assert serial.follow_rates(budgets, links, now) == {}
    state.round_trip_s, state.answered_at = 5.0, now + 6
    for rates in ({NUMBER: BITS_S / 2}, {}):
        assert serial.follow_rates(budgets, links, now + 6) == rates
    assert budgets[NUMBER].all.rate == BITS_S / 16
    assert budgets[NUMBER].copies.rate == BITS_S / 32
    later = [serial.follow_rates(budgets, links, now + at) for at in range(7, 60)]
    reported = [rates[NUMBER] for rates in later if rates]
    assert reported[-1] == BITS_S == 8 * budgets[NUMBER].all.rate
    assert len(reported) == 3  # each a quarter more than the one before, and the full rate


async def test_late_and_missing_answers_along_the_best_path_lower_the_budget(serial: SerialNetworks) -> None:
    """Not along another path, nor while the device is absent. After an answer it is half of that before."""
    now = monotonic()
    budgets = serial.budgets(now)
    state = SimpleNamespace(path=serial.path_to("sik"), round_trip_s=None, answered_at=0.0, is_off=False)
    requests, paths = SimpleNamespace(was_late=False, unanswered=0), SimpleNamespace(states=[state], best=None)
    links = cast(Any, [SimpleNamespace(peer=SimpleNamespace(paths=paths, echo_requests=requests))])
    for unanswered, was_late, best, is_off, bits_s in (
        (UNANSWERED, True, None, False, BITS_S),
        (UNANSWERED, True, state, True, BITS_S),
        (UNANSWERED - 1, False, state, False, BITS_S),
        (UNANSWERED, False, state, False, LEAST_BITS_S),
        (0, False, state, False, BITS_S / 2),
        (0, True, state, False, LEAST_BITS_S),
        (0, True, state, False, LEAST_BITS_S),
        (0, False, state, False, BITS_S / 4),
    ):
        requests.unanswered, requests.was_late, paths.best, state.is_off = unanswered, was_late, best, is_off
        serial.follow_rates(budgets, links, now)
        assert budgets[NUMBER].all.rate == bits_s / 8


async def test_finding_about_noise(serial: SerialNetworks) -> None:
    """It names the baud rate, and ends when the noise stops."""
    decoder = serial.networks[0].line.decoder
    serial.do_housekeeping()
    moment: Any = SimpleNamespace(
        daemon=SimpleNamespace(peer_sockets=SimpleNamespace(serial=serial)), now=monotonic()
    )
    assert [*line_noise(moment)] == []
    decoder.feed(report())
    decoder.feed(b"noise\0" * NOISE_PIECES)
    serial.do_housekeeping()
    (noise,) = line_noise(moment)
    assert (noise["noise"], noise["baud"]) == (NOISE_PIECES, 57600)
    line = cast(Any, serial.networks[0].status(monotonic())["serial"])
    assert line["radio"]["rssi"] == 200
    assert (line["discarded"]["bad_cobs"], line["discarded_bytes"]["bad_cobs"]) == (NOISE_PIECES, 5 * NOISE_PIECES)
    for _ in range(20):
        serial.do_housekeeping()
    assert [*line_noise(moment)] == []
    assert cast(Any, serial.networks[0].status(monotonic())["serial"])["radio"] is None, "old figures"


# The rate of a serial network: halved when a modem queues, and growing again.

FULL = 9_600.0
ENVELOPE = 300
WAIT_S = 2 * 8 * ENVELOPE / FULL
"""Two envelopes ahead."""


def test_rate_stays_while_round_trips_vary_a_little() -> None:
    """By what the envelopes of both ends take, and half a second."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    assert not rate.add_round_trip(0.2, 0.0)
    assert not rate.add_round_trip(0.2 + WAIT_S + LATER_S, 1.0)
    assert rate.bits_s(1.0) == FULL


def test_one_queue_halves_the_rate_once() -> None:
    """Answers to questions from before the halving do not count; later ones do."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.2, 0.0)
    assert rate.add_round_trip(3.0, 10.0)
    assert not rate.add_round_trip(3.0, 12.0)
    assert rate.add_round_trip(3.0, 13.1)


@pytest.mark.parametrize(("full", "least"), [(FULL, LEAST_BITS_S), (48_000.0, LEAST_SHARE * 48_000), (800.0, 800.0)])
def test_rate_has_a_least_value(full: float, least: float) -> None:
    """However late the answers are, while the shortest one is remembered."""
    rate = LineRate(full, 1, 0.0)
    rate.add_round_trip(0.1, 0.0)
    for at in range(1, 30):
        rate.add_round_trip(1.5, at * 1.6)
    assert rate.bits_s(0.0) == pytest.approx(least)


def test_shortest_round_trip_is_that_of_the_last_minute() -> None:
    """A radio that became slower is compared with what it does now."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.1, 0.0)
    rate.add_round_trip(0.9, 30.0)
    assert not rate.add_round_trip(1.5, SHORTEST_OF_S + 1)
    assert rate.add_round_trip(0.95 + WAIT_S + LATER_S, SHORTEST_OF_S + 2)


def test_a_day_without_a_look_grows_to_the_full_rate() -> None:
    """As after a suspend: the power of so many seconds would overflow."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.2, 0.0)
    assert rate.add_round_trip(5.0, 5.0)
    assert rate.bits_s(86_400.0) == FULL
