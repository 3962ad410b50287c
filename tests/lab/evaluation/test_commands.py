"""The commands of the evaluations, and the frame that they share."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import pytest

from uavlinkd.cli import main
from uavlinkd.lab.evaluation.commands import EVALUATIONS, add_evaluations, evaluation_of, settings_of
from uavlinkd.lab.evaluation.records import Record, RecordWriter


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_evaluations(parser.add_subparsers(required=True))
    return parser.parse_args(arguments)


@pytest.mark.parametrize("name", EVALUATIONS)
def test_defaults_are_those_of_the_settings(name: str) -> None:
    """Written twice, because the settings' modules are too heavy to import for a parser."""
    evaluation = evaluation_of(name)
    assert settings_of(evaluation, parse(name, "--out", "x")) == evaluation.settings()


def test_failure_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Here results that cannot be written."""
    (tmp_path / "file").write_text("")
    assert main(["evaluate", "flight", "--quick", "--out", f"{tmp_path}/file"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.long
def test_the_parsers_import_no_large_modules() -> None:
    """A command line is refused at once."""
    script = (
        "import sys; import uavlinkd.lab.evaluation.commands\n"
        "heavy = {'rich', 'cryptography', 'pydantic'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_report_of_an_interrupted_run_says_so(tmp_path: Path) -> None:
    evaluation = evaluation_of("tampering")
    with RecordWriter(tmp_path, "tampering", {"command": "uavlinkd evaluate", "cores": 2}) as writer:
        page = evaluation.write(tmp_path)
        assert "Not as expected: the run was interrupted." in page.read_text()
        writer.add(Record("end", {}, {"load_after": 2.5}))
    evaluation.write(tmp_path)
    assert "Not as expected" not in page.read_text()
    assert "Made by `uavlinkd evaluate`." in page.read_text()
    assert "| load after | 2.5 |" in page.read_text()
