"""``uavlinkd evaluate tampering`` at the command line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from uavlinkd.cli import main


@pytest.mark.parametrize(
    "flags", [["--attempts-data", "0"], ["--attempts-handshake", "-1"], ["--attempts-data", "x"], ["--only", "x"], []]
)
def test_impossible_flags_are_refused(tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers must be 1 or more, and --out is required; status 2 before a start."""
    out = ["--out", str(tmp_path / "out")] if flags else []
    with pytest.raises(SystemExit) as raised:
        main(["evaluate", "tampering", *out, *flags])
    assert raised.value.code == 2
    assert "usage" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_results_that_cannot_be_written_are_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before anything is started; status 1, one line."""
    (tmp_path / "file").write_text("")
    assert main(["evaluate", "tampering", "--quick", "--out", str(tmp_path / "file")]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_without_matplotlib_one_line_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before minutes are spent on a run without figures."""
    for name in [
        module for module in sys.modules if module.startswith(("matplotlib", "uavlinkd.lab.evaluation.tampering_"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["evaluate", "tampering", "--quick", "--out", str(tmp_path)]) == 1
    assert "pip install '.[evaluation]'" in capsys.readouterr().err
