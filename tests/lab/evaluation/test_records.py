"""Records can be written and read without loss."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.lab.evaluation.samples import FAILED, RUN, frames, handshake
from uavlinkd.lab.evaluation.records import RecordsError, RecordWriter, read_records


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    """Facts, points, numbers, lists, status and reason are unchanged."""
    written = [handshake("x25519", 256, 0.0041), FAILED, frames([1.5, 2.5])]
    with RecordWriter(tmp_path / "new", "timing", RUN) as writer:
        for record in written:
            writer.add(record)
    assert read_records(tmp_path / "new" / "timing.jsonl") == (RUN, written)


def test_a_run_that_is_interrupted_leaves_what_it_measured(tmp_path: Path) -> None:
    """Each record is in the file as soon as it is added."""
    writer = RecordWriter(tmp_path, "timing", RUN)
    writer.add(FAILED)
    assert read_records(tmp_path / "timing.jsonl") == (RUN, [FAILED])
    writer.close()


def test_the_csv_has_a_row_for_every_record_and_the_facts_in_each(tmp_path: Path) -> None:
    """A failed record is a row too, with its reason; lists are omitted."""
    with RecordWriter(tmp_path, "timing", RUN) as writer:
        for record in (handshake("x25519", 256, 0.5), FAILED, frames([1.0])):
            writer.add(record)
    with (tmp_path / "timing.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok", "failed", "ok"]
    assert rows[0]["total_s"] == "0.5"
    assert rows[1]["reason"] == FAILED.reason
    assert {row["run_seed"] for row in rows} == {"7"}
    assert "latency_s" not in rows[2]


@pytest.mark.parametrize(
    "content",
    ["", "{}\n", "not json\n", '{"run": {}}\n{"kind": "x"}\n', '{"run": {}}\n[]\n', '{"run": 5}\n',
     '{"run": {}}\n{"kind": "x", "status": "great", "reason": "", "point": {}, "values": {}}\n'],
)  # fmt: skip
def test_malformed_records_are_refused_with_the_file(tmp_path: Path, content: str) -> None:
    """Anything else than records raises one error that a person can read."""
    path = tmp_path / "timing.jsonl"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(RecordsError, match=r"timing\.jsonl"):
        read_records(path)


def test_missing_records_are_an_error_that_says_so(tmp_path: Path) -> None:
    """No file, no traceback."""
    with pytest.raises(RecordsError, match="No such file"):
        read_records(tmp_path / "timing.jsonl")


def test_a_number_is_a_number() -> None:
    """What is missing or no number is a KeyError, never a wrong number."""
    record = frames([1.0])
    assert record.number("sent") == 1.0
    for name in ("latency_s", "absent"):
        with pytest.raises(KeyError):
            record.number(name)
