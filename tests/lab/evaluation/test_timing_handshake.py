"""Handshakes and rekeys of real daemons, timed."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.core.suites import SUITES_BY_NAME, X25519
from uavlinkd.core.wire import initiation_bytes, response_bytes
from uavlinkd.lab.evaluation import timing_handshake
from uavlinkd.lab.evaluation.machine import EnergyMeter
from uavlinkd.lab.evaluation.pair import DaemonProcess, LinkChoice, PairError
from uavlinkd.lab.evaluation.records import Status
from uavlinkd.lab.evaluation.timing_handshake import measure_handshake, measure_rekeys


def test_a_handshake_is_timed_and_counted_whole(tmp_path: Path) -> None:
    """Its parts are within the whole, its messages within the bytes, both sides worked."""
    suite = SUITES_BY_NAME["ffdhe2048"]
    record = measure_handshake(LinkChoice(suite, 512), EnergyMeter(tmp_path))
    assert record.is_ok, record.reason
    assert record.point == {"suite": "ffdhe2048", "mac_key_bits": 512, "confidential": False}
    assert 0 < record.number("response_s") < record.number("response_s") + record.number("frame_s")
    assert record.number("response_s") + record.number("frame_s") < record.number("total_s") < 20
    assert record.number("bytes_there") > initiation_bytes(suite)
    assert record.number("bytes_back") >= response_bytes(suite)
    assert record.number("cpu_initiator_s") > 0
    assert record.number("cpu_responder_s") > 0
    assert record.values["joules"] is None


def test_a_handshake_that_fails_is_recorded_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """A point that fails is a record, not an exception that ends the run."""

    def refuse(self: DaemonProcess) -> bool:
        raise PairError("initiator ended with status 1")

    monkeypatch.setattr(DaemonProcess, "is_ready", refuse)
    failed = [measure_handshake(LinkChoice(X25519), EnergyMeter()), *measure_rekeys(LinkChoice(X25519), 3)]
    assert [(note.kind, note.status) for note in failed] == [("handshake", Status.FAILED), ("rekey", Status.FAILED)]
    assert {record.reason for record in failed} == {"initiator ended with status 1"}


def test_rekeys_replace_the_keys_of_running_daemons() -> None:
    """The requested number of rekeys, each with its own handshake."""
    records = measure_rekeys(LinkChoice(X25519), 2)
    assert [record.is_ok for record in records] == [True, True], records
    for record in records:
        assert 0 < record.number("response_s") <= record.number("total_s")


def test_no_session_in_time_is_an_error_that_tells_what_was_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of initiations, and the responder's dropped datagrams."""
    monkeypatch.setattr(timing_handshake, "HANDSHAKE_LIMIT_S", 0.5)
    monkeypatch.setattr(timing_handshake, "ENVELOPES", ())  # as if no envelope ever came
    record = measure_handshake(LinkChoice(X25519), EnergyMeter())
    assert record.status is Status.FAILED
    assert "no session within 0.5 s, after" in record.reason
    assert "responder dropped" in record.reason
