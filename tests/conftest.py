"""What every test may lean on: where the recorded flights are, and that CI skips nothing that it is to have."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import pytest

MAY_BE_MISSING = (
    "no ProVerif",
    "no recorded flights",
    "needs a writable cgroup",
    "needs an interface with a link-local IPv6 address",
    "this machine does not know its own name",
)
"""How the reasons begin for which a test may be skipped in CI too: see the README."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """In CI all else is installed: a skip is a failure."""
    report = yield
    if os.environ.get("CI") and report.skipped and isinstance(report.longrepr, tuple):
        _, _, told = report.longrepr
        reason = told.removeprefix("Skipped: ")
        if not reason.startswith(MAY_BE_MISSING):
            report.outcome, report.longrepr = "failed", f"skipped, and that in CI: {reason}"
    return report


def _shared_folder() -> Path | None:
    """The folder ``shared`` named by UAVLINKD_SHARED, or beside the checkout."""
    named = os.environ.get("UAVLINKD_SHARED")
    if named and not (Path(named) / "data").is_dir():
        raise pytest.UsageError(f"UAVLINKD_SHARED names {named}, where no folder `data` is")
    candidates = [Path(named)] if named else [parent / "shared" for parent in Path(__file__).parents]
    return next((folder for folder in candidates if (folder / "data").is_dir()), None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded flights (.tlog), which are not part of the project."""
    folder = _shared_folder()
    if folder is None:
        pytest.skip("no recorded flights: set UAVLINKD_SHARED to a folder that has data/*.tlog")
    return folder / "data"
