"""Serial networks beside the UDP sockets: their paths, their budgets, what the status and the findings say."""

from __future__ import annotations

import errno
from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import pytest
import structlog
from structlog.testing import capture_logs

from tests.endpoints.test_line_framing import report
from tests.link.socket_states import SocketStateLog
from tests.waiting import until
from uavlinkd.config import NetworkConfig, PeerAddress
from uavlinkd.config.model import SERIAL
from uavlinkd.core.constants import LINE_BYTES
from uavlinkd.core.path import Path
from uavlinkd.endpoints import serial as serial_devices
from uavlinkd.endpoints.serial_line import SerialLine
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.link.diagnosis import _line_noise, _modem_reports
from uavlinkd.link.networks import wire_bytes
from uavlinkd.link.serial_networks import NOISE_PIECES, PLUG_IN, SHARE_UNANSWERED, UNANSWERED, SerialNetworks
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


async def test_path_and_peer_at_the_other_end(serial: SerialNetworks) -> None:
    """One path for each line, to the peer that names it; a datagram costs its framing there."""
    assert serial.path_to("sik") == Path(NUMBER, ("serial", 0))
    assert serial.path_to("lte") is None
    links = [
        SimpleNamespace(config=SimpleNamespace(addresses=[PeerAddress(SERIAL, name)]), peers=[name])
        for name in ("sik", "other")
    ]
    assert list(map(str, serial.peers_at(cast(Any, links))[NUMBER])) == ["sik"]
    assert wire_bytes(bytes(100), Path(NUMBER, ("serial", 0))) == 100 + LINE_BYTES


async def test_absent_device_is_reported(serial: SerialNetworks, states: SocketStateLog) -> None:
    """To the core after each change of paths, once to the log, and in the status."""
    with capture_logs() as logs:
        serial.report_absent()
        serial.do_housekeeping()
        serial.do_housekeeping()
    assert states.states == [(NUMBER, False)]
    assert [line["event"] for line in logs] == ["network_not_here_yet"]
    ((absent, remedy),) = serial.absent().items()
    assert absent.startswith("sik (")
    assert remedy == PLUG_IN
    status = serial.networks[0].status(monotonic())
    assert (status["is_present"], status["addresses"]) == (False, [])


@pytest.mark.parametrize(
    ("error", "remedy"),
    [("EACCES", "dialout"), ("EBUSY", "ModemManager"), ("ENOENT", "plug it in"), ("ENOTTY", "name")],
)
async def test_remedy_names_what_keeps_the_device_closed(serial: SerialNetworks, error: str, remedy: str) -> None:
    """A missing permission, and another process that has the device, are not mended by the plug."""
    line = serial.networks[0].line
    with patch.object(serial_devices, "open_device", side_effect=OSError(getattr(errno, error), "")):
        line.start()
        try:
            await until(lambda: bool(line.failures))
        finally:
            line.close()
    ((absent, text),) = serial.absent().items()
    assert absent == f"sik ({line.url.device} cannot be opened ({error}))"
    assert remedy in text


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
    traffic, paths = SimpleNamespace(echoes_unanswered=0), SimpleNamespace(states=[state], best=state)
    links = cast(Any, [SimpleNamespace(peer=SimpleNamespace(paths=paths, traffic=traffic))])
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


async def test_unanswered_questions_lower_the_budget_of_the_best_path(serial: SerialNetworks) -> None:
    """Those along another path do not count, nor while the device is absent, nor does a total that begins again."""
    now = monotonic()
    budgets = serial.budgets(now)
    state = SimpleNamespace(path=serial.path_to("sik"), round_trip_s=None, answered_at=0.0, is_off=False)
    traffic, paths = SimpleNamespace(echoes_unanswered=0), SimpleNamespace(states=[state], best=None)
    links = cast(Any, [SimpleNamespace(peer=SimpleNamespace(paths=paths, traffic=traffic))])
    for total, best, share in (
        (40, "off", 1.0),
        (50, None, 1.0),
        (UNANSWERED - 1, state, 1.0),
        (2 * UNANSWERED - 2, state, 1.0),
        (2 * UNANSWERED - 1, state, SHARE_UNANSWERED),
    ):
        traffic.echoes_unanswered, paths.best, state.is_off = total, state if best == "off" else best, best == "off"
        serial.follow_rates(budgets, links, now)
        assert budgets[NUMBER].all.rate == share * BITS_S / 8


async def test_findings_about_modem_and_noise(serial: SerialNetworks) -> None:
    """They name the setting, and end when it stops."""
    decoder = serial.networks[0].line.decoder
    serial.do_housekeeping()
    moment: Any = SimpleNamespace(daemon=SimpleNamespace(peer_sockets=SimpleNamespace(serial=serial)))
    assert [*_modem_reports(moment), *_line_noise(moment)] == []
    decoder.feed(report())
    decoder.feed(b"noise\0" * NOISE_PIECES)
    serial.do_housekeeping()
    (modem,), (noise,) = _modem_reports(moment), _line_noise(moment)
    assert "MAVLINK=0" in modem.remedy
    assert "57600" in noise.remedy
    line = cast(Any, serial.networks[0].status(monotonic())["serial"])
    assert line["radio"]["rssi"] == 200
    assert (line["discarded"]["bad_cobs"], line["discarded_bytes"]["bad_cobs"]) == (NOISE_PIECES, 5 * NOISE_PIECES)
    for _ in range(20):
        serial.do_housekeeping()
    assert [*_modem_reports(moment), *_line_noise(moment)] == []
    assert cast(Any, serial.networks[0].status(monotonic())["serial"])["radio"] is None, "old figures"
