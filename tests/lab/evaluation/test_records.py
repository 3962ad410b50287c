"""Records can be written and read without loss."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.lab.evaluation.records import Record, RecordsError, RecordWriter, Status, Value, read_records

RUN: dict[str, Value] = {"cpu": "a test", "seed": 7, "uvloop": None}
FAILED = Record("handshake", {"suite": "mlkem768", "mac_key_bits": 256}, {}, Status.FAILED, "no session in 20 s")
FRAMES = Record("frames", {"suite": "x25519"}, {"sent": 2, "latency_s": [1.5, 2.5], "wire": {"there": 3}})


def test_records_are_read_as_written_also_of_an_interrupted_run(tmp_path: Path) -> None:
    """Each record is in the file as soon as it is added."""
    with RecordWriter(tmp_path / "new", "timing", RUN) as writer:
        for record in (FAILED, FRAMES):
            writer.add(record)
        assert read_records(tmp_path / "new" / "timing.jsonl") == (RUN, [FAILED, FRAMES])


@pytest.mark.parametrize(
    "content",
    ["", "{}\n", "not json\n", '{"run": {}}\n{"kind": "x"}\n', '{"run": {}}\n[]\n', '{"run": 5}\n', "\xff",
     '{"run": {}}\n{"kind": "x", "status": "great", "reason": "", "point": {}, "values": {}}\n'],
)  # fmt: skip
def test_malformed_records_are_refused_with_the_file(tmp_path: Path, content: str) -> None:
    """Anything else than records raises one error that a person can read; also a missing file."""
    path = tmp_path / "timing.jsonl"
    with pytest.raises(RecordsError, match=r"timing\.jsonl: No such file"):
        read_records(path)
    path.write_text(content, encoding="latin-1")
    with pytest.raises(RecordsError, match=r"timing\.jsonl"):
        read_records(path)
