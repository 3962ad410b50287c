"""Serial networks beside the UDP sockets: their paths, their budgets, what the status and the findings say."""

from __future__ import annotations

import struct
from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog

from tests.daemon.socket_states import SocketStateLog
from tests.serial.test_line_framing import report
from uavlinkd.config.model import NetworkConfig
from uavlinkd.io.url import SerialUrl
from uavlinkd.observe.signs import line_noise
from uavlinkd.serial.serial_line import SerialLine
from uavlinkd.serial.serial_networks import NOISE_PIECES, SerialNetworks
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
    serial = SerialNetworks([sik], states, stall, structlog.get_logger())
    serial.open(lambda *_: NUMBER)
    return serial


async def test_change_is_due_at_once(
    serial: SerialNetworks, states: SocketStateLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon sets its timer after the core knows: else the first try waits for the housekeeping, up to 1 s."""
    known = list[list[tuple[int, bool]]]()
    monkeypatch.setattr(SerialLine, "start", lambda line: None)
    serial.start(lambda *read: None, lambda: known.append(list(states.states)), lambda: None)
    (network,), is_open = serial.networks, [False]
    monkeypatch.setattr(SerialLine, "is_open", property(lambda line: is_open[0]))
    for is_open[0] in (True, False):
        network.report_state(is_change=True)
    assert known == [[(NUMBER, True)], [(NUMBER, True), (NUMBER, False)]]


async def test_this_end_backs_off_while_the_modem_reports_a_full_buffer(
    serial: SerialNetworks, states: SocketStateLog
) -> None:
    """Frames and their copies, for 2 s after a report. A modem that reports room again has its rate at once."""
    budget, decoder = serial.networks[0].budget, serial.networks[0].line.decoder
    assert budget.all.rate == BITS_S / 8
    assert budget.all.burst == pytest.approx(300, abs=5)
    full, room = (report(payload=struct.pack("<HHBBBBB", 0, 0, 200, 180, txbuf, 30, 40)) for txbuf in (19, 20))
    for reports, rate in ((b"", BITS_S), (full, BITS_S / 4), (b"", BITS_S / 4), (b"", BITS_S), (full, BITS_S / 4)):
        decoder.feed(reports)
        serial.do_housekeeping()
        assert budget.all.rate == rate / 8
        assert budget.copies.rate == rate / 16
    decoder.feed(room)
    serial.do_housekeeping()
    assert states.rates[-1] == {NUMBER: BITS_S}
    assert cast(Any, serial.networks[0].status()["serial"])["rate_bits_s"] == BITS_S


async def test_finding_about_noise(serial: SerialNetworks) -> None:
    """It names the baud rate, and ends when the noise stops."""
    decoder = serial.networks[0].line.decoder
    serial.do_housekeeping()
    moment: Any = SimpleNamespace(daemon=SimpleNamespace(serial=serial), now=monotonic())
    assert [*line_noise(moment)] == []
    decoder.feed(report())
    decoder.feed(b"noise\0" * NOISE_PIECES)
    serial.do_housekeeping()
    (noise,) = line_noise(moment)
    assert (noise["noise"], noise["baud"]) == (NOISE_PIECES, 57600)
    line = cast(Any, serial.networks[0].status()["serial"])
    assert line["radio"]["rssi"] == 200
    assert (line["discarded"]["bad_cobs"], line["discarded_bytes"]["bad_cobs"]) == (NOISE_PIECES, 5 * NOISE_PIECES)
    for _ in range(20):
        serial.do_housekeeping()
    assert [*line_noise(moment)] == []
    assert cast(Any, serial.networks[0].status()["serial"])["radio"] is None, "old figures"
