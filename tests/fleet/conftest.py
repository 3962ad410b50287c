"""Commands as an operator runs them."""

from __future__ import annotations

import io
from collections.abc import Callable

import cryptography.hazmat.primitives.serialization  # noqa: F401  a module without a specification stays loaded
import pytest

from uavlinkd.cli import main

Say = Callable[..., str]


@pytest.fixture
def say(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Say:
    """Runs a command; returns its standard output, or its error after `refused: `."""

    def run(command: str, line: str = "") -> str:
        monkeypatch.setattr("sys.stdin", io.StringIO(line))
        status = main(command.split())
        out, err = capsys.readouterr()
        return out if status == 0 else f"refused: {err}"

    return run
