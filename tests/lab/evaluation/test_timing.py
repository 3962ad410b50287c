"""``uavlinkd evaluate timing``: the measurements, and a quick run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.lab.evaluation.records import Status
from uavlinkd.lab.evaluation.timing_daemons import measured, time_handshake
from uavlinkd.lab.evaluation.timing_report import TimingFindings, timing_problems
from uavlinkd.lab.evaluation.timing_run import PAPER_DH_BITS, TIMING, measure_paper
from uavlinkd.protocol.suites import SUITES, X25519


@pytest.mark.long
async def test_handshake_of_daemons_is_timed() -> None:
    """From the initiation to the delivered frame."""
    handshake = await time_handshake(X25519)
    assert handshake["total_s"] > 0
    assert min(handshake["cpu_initiator_s"], handshake["cpu_responder_s"]) > 0
    assert handshake["bytes"] > [200, 100]
    assert handshake["datagrams"][0] >= 3


@pytest.mark.long
async def test_failed_measurement_is_a_record_with_its_reason() -> None:
    """And a problem of the run. Here a suite that the daemon refuses: the log of the process names the key."""
    record = await measured("handshake", {}, time_handshake(replace(X25519, name="x448")))
    assert (record.status, record.values) == (Status.FAILED, {})
    assert "suites" in record.reason
    assert timing_problems(TimingFindings({}, [record])) == [f"handshake, : {record.reason}"]


@pytest.mark.long
async def test_exchange_of_the_paper_is_measured_in_a_process(capfd: pytest.CaptureFixture[str]) -> None:
    """Or recorded with the limit, or with the status of a process that failed: OpenSSL refuses 256 bits."""
    done = await measure_paper(512, 60, b"data")
    assert 0 < done.number("parameters_s") < done.number("total_s")
    late = await measure_paper(4096, 0.1, b"data")
    assert (late.status, late.reason) == (Status.NOT_FINISHED, "not finished in 0.1 s")
    failed = await measure_paper(256, 60, b"data")
    assert failed.status is Status.FAILED
    assert "ended with status 1" in failed.reason
    assert "ValueError" in capfd.readouterr().err


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """Every suite is measured, and every point of the paper's grid has a record: a time, or the reason for none."""
    result = await run_quickly("timing", tmp_path, "--seed", "3")
    assert (result.status, result.err) == (0, "")
    findings = TIMING.read(tmp_path)
    assert json.loads(result.out.splitlines()[-1]) == TIMING.summary(findings)
    assert {record.point["dh_bits"] for record in findings.of("paper")} == set(PAPER_DH_BITS)
    assert all(record.is_ok or record.reason for record in findings.records)
    linked = {record.point["suite"] for record in findings.of("handshake") if record.is_ok}
    assert linked == {suite.name for suite in SUITES.values()}
    assert {record.kind for record in findings.records if record.is_ok} >= {"paper", "handshake"}
    assert "ffdhe2048" in (tmp_path / "timing.md").read_text()
