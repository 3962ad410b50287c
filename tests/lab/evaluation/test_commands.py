"""The commands of the evaluation."""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.needs import need
from uavlinkd.cli import main
from uavlinkd.lab.evaluation.commands import add_report_parser, add_timing_parser
from uavlinkd.lab.evaluation.timing import TimingSettings


def parse(*arguments: str) -> argparse.Namespace:
    """As the command line does."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(required=True)
    add_timing_parser(commands)
    add_report_parser(commands)
    return parser.parse_args(arguments)


def test_defaults_are_those_of_the_settings() -> None:
    """Written twice, because the settings' module is too heavy to import for a parser."""
    options, settings = parse("timing", "--out", "x"), TimingSettings()
    assert (options.repeats, options.limit, options.seed) == (settings.repeats, settings.limit_s, settings.seed)
    assert (options.watts_per_core, options.quick, options.paper) == (settings.watts_per_core, False, False)


@pytest.mark.parametrize(
    "arguments",
    [("--repeats", "0"), ("--repeats", "x"), ("--limit", "0"), ("--limit", "nan"), ("--limit", "inf"),
     ("--watts-per-core", "-1"), ("--watts-per-core", "nan")],
)  # fmt: skip
def test_senseless_numbers_are_refused(arguments: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    """By name, before anything starts."""
    with pytest.raises(SystemExit) as ended:
        parse("timing", "--out", "x", *arguments)
    assert ended.value.code == 2
    assert arguments[0] in capsys.readouterr().err


def test_a_report_of_nothing_fails_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No traceback."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    options = parse("report", str(tmp_path))
    assert options.command(options) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_without_matplotlib_the_report_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Plotting is an extra."""
    for name in [*sys.modules]:
        if name.partition(".")[0] == "matplotlib" or name in (
            "uavlinkd.lab.evaluation.report",
            "uavlinkd.lab.evaluation.figures",
        ):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    options = parse("report", str(tmp_path))
    assert options.command(options) == 1
    assert "'.[evaluation]'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["timing", "tampering", "flight", "paths", "report", "captured-member"])
def test_help_says_what_to_install_before_the_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A reader learns of matplotlib before a run fails for lack of it. One evaluation has no figures."""
    with pytest.raises(SystemExit):
        main(["evaluate", name, "--help"])
    assert ("'.[evaluation]'" in capsys.readouterr().out) == (name != "captured-member")


def test_the_parsers_and_the_measurements_import_nothing_of_the_figures() -> None:
    """The parsers import no large modules; the measurements run without matplotlib."""
    script = (
        "import sys; import uavlinkd.lab.evaluation.commands\n"
        "heavy = {'matplotlib', 'rich', 'cryptography', 'asyncio', 'pydantic'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "import uavlinkd.lab.evaluation.timing\n"
        "assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
