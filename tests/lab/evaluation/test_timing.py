"""``uavlinkd evaluate timing``: the measurements, and a quick run."""

from __future__ import annotations

import hmac
import json
from collections import Counter
from pathlib import Path

import pytest

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.core.suites import SUITES, X25519
from uavlinkd.lab.evaluation.records import Status, Value
from uavlinkd.lab.evaluation.timing_daemons import (
    MESSAGE_BYTES,
    TAG_KEY_BITS,
    LinkChoice,
    measure_core,
    measure_tags,
    measured,
    tag_makers,
    time_frames,
    time_handshake,
)
from uavlinkd.lab.evaluation.timing_run import MAC_KEY_BITS, TIMING, measure_paper, paper_points


def test_both_variants_make_the_same_tag_and_every_key_is_measured() -> None:
    """RFC 2104, section 2: what the two are compared for is one and the same function."""
    for bits in TAG_KEY_BITS:
        key = bytes(range(256))[: bits // 8]
        assert {make() for make in tag_makers(key, b"message").values()} == {hmac.digest(key, b"message", "sha256")}
    points = {tuple(record.point.values()) for record in measure_tags(5) if record.number("tag_least_s") > 0}
    states = ("prepared", "from the key")
    assert points == {(bits, way, size) for bits in TAG_KEY_BITS for way in states for size in MESSAGE_BYTES}


@pytest.mark.parametrize("number", SUITES)
@pytest.mark.parametrize("confidential", [False, True])
def test_every_suite_carries_a_frame_between_two_nodes(number: int, confidential: bool) -> None:
    """The steps add up to the total, and the frame was delivered."""
    record = measure_core(LinkChoice(SUITES[number], 1024, confidential))
    steps = [record.number(f"{name}_s") for name in ("initiate", "respond", "finish", "confirm", "frame")]
    assert min(steps) > 0
    assert record.number("total_s") == pytest.approx(sum(steps))


async def test_handshake_and_frames_of_daemons_are_timed() -> None:
    """From the initiation to the delivered frame; each frame arrives after it was sent."""
    handshake = await time_handshake(LinkChoice(X25519, 512, confidential=True))
    assert handshake["total_s"] > 0
    assert min(handshake["cpu_initiator_s"], handshake["cpu_responder_s"]) > 0
    assert handshake["bytes"] > [200, 100]
    assert handshake["datagrams"][0] >= 3
    frames = await time_frames(LinkChoice(X25519), 20, with_proxy=False)
    assert len(frames["latency_s"]) == 20
    assert min(frames["latency_s"]) > 0


async def test_failed_measurement_is_a_record_with_its_reason() -> None:
    """Here a length that the daemon refuses: the log of the process names the key."""
    record = await measured("handshake", {}, time_handshake(LinkChoice(X25519, 257)))
    assert (record.status, record.values) == (Status.FAILED, {})
    assert "mac_key_bits" in record.reason


def point(dh_bits: int, group: str = "made") -> dict[str, Value]:
    return {"dh_bits": dh_bits, "mac_key_bits": 512, "group": group}


async def test_exchange_of_the_paper_is_measured_between_two_processes(capfd: pytest.CaptureFixture[str]) -> None:
    """Or recorded with the limit, or with the status of a process that failed: RFC 7919 has no group of 512 bits."""
    done = await measure_paper(point(512), 60, b"data")
    assert 0 < done.number("parameters_s") < done.number("total_s")
    late = await measure_paper(point(4096), 0.6, b"data")
    assert (late.status, late.reason) == (Status.NOT_FINISHED, "not finished in 0.6 s")
    failed = await measure_paper(point(512, "standard"), 60, b"data")
    assert failed.status is Status.FAILED
    assert "ended with status 1" in failed.reason
    assert "KeyError" in capfd.readouterr().err


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """Every point of both grids has a record: measured, or with the reason why it is not."""
    result = await run_quickly("timing", tmp_path, "--seed", "3")
    assert (result.status, result.err) == (0, "")
    findings = TIMING.read(tmp_path)
    assert json.loads(result.out.splitlines()[-1]) == TIMING.summary(findings)
    handshakes = {(record.point["suite"], record.point["mac_key_bits"]) for record in findings.of("handshake")}
    assert handshakes == {(suite.name, bits) for suite in SUITES.values() for bits in MAC_KEY_BITS}
    papers = [dict(record.point) for record in findings.of("paper")]
    assert all(planned in papers for planned in paper_points())
    assert all(record.is_ok or record.reason for record in findings.records)
    linked = {record.point["suite"] for record in findings.of("handshake") if record.is_ok}
    assert linked == {suite.name for suite in SUITES.values()}
    measured_kinds = Counter(record.kind for record in findings.records if record.is_ok)
    assert all(measured_kinds[kind] for kind in ("paper", "handshake", "frames", "core", "mac"))
    large = findings.of("paper", dh_bits=4096, group="made")
    assert {(record.status, record.reason) for record in large} == {(Status.SKIPPED, "runs only with --paper")}
    report = (tmp_path / "timing.md").read_text()
    assert all(f"({name}.svg)" in report and (tmp_path / f"{name}.svg").exists() for name in ("scatter", "histogram"))
