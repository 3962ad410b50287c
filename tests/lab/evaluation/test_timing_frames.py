"""Frames on an established link, timed."""

from __future__ import annotations

import pytest

from uavlinkd.core.suites import X25519
from uavlinkd.lab.evaluation.machine import EnergyMeter
from uavlinkd.lab.evaluation.pair import DaemonProcess, LinkChoice, PairError
from uavlinkd.lab.evaluation.records import Status
from uavlinkd.lab.evaluation.timing_frames import measure_frames


def test_every_frame_that_arrives_has_its_latency() -> None:
    """On a link without losses, every frame arrives, after it was sent."""
    record = measure_frames(LinkChoice(X25519, confidential=True), 20, EnergyMeter(), with_relay=True)
    assert record.is_ok, record.reason
    latencies = record.values["latency_s"]
    assert isinstance(latencies, list)
    assert record.number("delivered") == len(latencies) == 20
    assert min(latencies) > 0
    assert record.point["relay"] is True


def test_a_link_that_does_not_come_up_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the reason, and without a latency."""

    def refuse(self: DaemonProcess) -> bool:
        raise PairError("answerer did not start within 20 s")

    monkeypatch.setattr(DaemonProcess, "is_ready", refuse)
    record = measure_frames(LinkChoice(X25519), 20, EnergyMeter())
    assert (record.status, record.reason, record.values) == (Status.FAILED, "answerer did not start within 20 s", {})
