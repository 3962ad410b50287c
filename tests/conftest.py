"""Settings of the whole test run: its workers, the order of its tests, the recorded flights, and no skips in CI."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator
from pathlib import Path

import pytest

MAY_BE_MISSING = (
    "no ProVerif",
    "no recorded flights",
    "no autopilot simulator",
    "needs a writable cgroup",
    "needs an interface with a link-local IPv6 address",
    "this machine does not know its own name",
)
"""How the reasons begin for which a test may be skipped in CI too: see tests/README.md."""


WORKERS_PER_CORE = 2
"""Most tests wait for daemons, clients and containers."""
SLOWEST = ("packages", "compose", "faults", "soak", "evaluation", "bench", "fleet", "pressure", "daemon", "network")
"""Folders, the slowest tests first."""
ALONE = ("pressure", "faults", "soak", "daemon", "link")
"""Folders whose tests measure delays, losses and processor time of real daemons: marked ``alone``."""


def pytest_configure() -> None:
    """Accept Ctrl-C, and let children do so: a shell starts what runs in its background without."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run a whole suite in parallel. A run of chosen tests needs no workers, whose start takes seconds."""
    is_whole = config.args_source is config.ArgsSource.TESTPATHS
    return WORKERS_PER_CORE * (os.cpu_count() or 1) if is_whole else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what runs alone. Start the slowest files first, so that no worker starts one at the end."""
    for item in items:
        if set(ALONE) & set(item.nodeid.partition("::")[0].split("/")):  # not by the path of the checkout
            item.add_marker("alone")
    items.sort(
        key=lambda item: next((n for n, folder in enumerate(SLOWEST) if folder in item.path.parts), len(SLOWEST))
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """In CI all tools are installed: a skip is a failure."""
    report = yield
    if os.environ.get("CI") and report.skipped and isinstance(report.longrepr, tuple):
        _, _, message = report.longrepr
        reason = message.removeprefix("Skipped: ")
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
