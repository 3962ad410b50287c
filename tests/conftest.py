"""Settings of the whole test run: its workers, the order of its tests, traces, skips in CI, recorded flights."""

from __future__ import annotations

import asyncio
import os
import signal
import tempfile
from collections.abc import AsyncIterator, Generator, Iterator
from pathlib import Path

import pytest
import structlog
from hypothesis import HealthCheck, settings

from tests.needs import MAY_BE_MISSING
from tests.traces import END_S, no_trace, open_once
from uavlinkd.system import process

WORKERS_PER_CORE = 2
"""Most long tests wait for daemons, clients and containers. The others compute: one worker for each core."""
SLOWEST = (
    "mitm",
    "packages",
    "compose",
    "faults",
    "evaluation",
    "bench",
    "fleet",
    "pressure",
    "processes",
    "network",
)
"""Folders, the slowest tests first."""
ALONE = ("pressure", "faults", "processes", "daemon", "tls")
"""Folders whose tests measure delays, losses and processor time of real daemons: marked ``alone``."""
LONG_ALL = ("natlab", "faults", "compose", "bench", "pressure", "walkthroughs", "wireshark")
"""Folders of machines, routers, containers, other software: all is ``long``, and imported only if selected."""
LONG = (*LONG_ALL, "processes")
"""Folders whose tests are marked ``long``, except those with the marker ``short``."""

EXAMPLES = int(os.environ.get("UAVLINKD_EXAMPLES", "25"))
"""How many examples each property is tried with. `.ci/run` has more for the core."""

settings.register_profile(
    "busy machine", max_examples=EXAMPLES, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("busy machine")


def pytest_configure() -> None:
    """Accept Ctrl-C, and let children do so: a shell starts what runs in its background without.

    pymavlink sets MAVLINK20 itself when it reads the first frame of MAVLink 2.
    """
    os.environ.setdefault("MAVLINK20", "1")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run a whole suite in parallel. A run of chosen tests needs no workers, whose start takes seconds."""
    is_whole = config.args_source is config.ArgsSource.TESTPATHS
    per_core = 1 if _leaves_out_long(config) else WORKERS_PER_CORE
    return per_core * (os.cpu_count() or 1) if is_whole else 0


def _leaves_out_long(config: pytest.Config) -> bool:
    return str(config.getoption("markexpr")).startswith("not long")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no module of which no test would run."""
    return True if collection_path.name in LONG_ALL and _leaves_out_long(config) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what runs alone, what is long and what reads recorded flights. Start the slowest files first.

    A worker that starts one at the end makes the others wait. The order within a folder stays random.
    """
    for item in items:
        if set(ALONE) & _folders(item):
            item.add_marker("alone")
        starts_daemons = "stage" in getattr(item, "fixturenames", ())
        if (starts_daemons or set(LONG) & _folders(item)) and not item.get_closest_marker("short"):
            item.add_marker("long")
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker("recorded")
            item.add_marker("long")
    items.sort(
        key=lambda item: next((n for n, folder in enumerate(SLOWEST) if folder in _folders(item)), len(SLOWEST))
    )


def _folders(item: pytest.Item) -> set[str]:
    """Those within the project: the checkout may be in a folder of any name."""
    return set(item.nodeid.partition("::")[0].split("/"))


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


@pytest.fixture(scope="session", autouse=True)
def _opened_once() -> None:
    open_once()


@pytest.fixture(scope="module", autouse=True)
def _module_leaves_no_trace(_opened_once: None) -> Iterator[None]:
    with no_trace("this module"):
        yield


@pytest.fixture(autouse=True)
def _leaves_no_trace(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves something in its process: see tests/traces.py."""
    shares_its_loop = _loop_scope(request) not in (None, "function")
    with no_trace("this test", has_resources=not (shares_its_loop or _shares_a_fixture(request))):
        yield


@pytest.fixture(autouse=True)
def _leaves_no_task(_leaves_no_trace: None, request: pytest.FixtureRequest) -> None:
    """Fail a test that leaves a running task in its event loop."""
    if _loop_scope(request) == "function":
        request.getfixturevalue("_tasks_end")  # after all other fixtures of the test, before its loop is closed


@pytest.fixture
async def _tasks_end() -> AsyncIterator[None]:
    yield
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    left = (await asyncio.wait(tasks, timeout=END_S))[1] if tasks else ()
    assert not left, "\n  ".join(["this test left in its event loop:", *map(str, left)])


def _loop_scope(request: pytest.FixtureRequest) -> str | None:
    """Which tests share the event loop of an asynchronous one."""
    marker = request.node.get_closest_marker("asyncio")
    return None if marker is None else marker.kwargs.get("loop_scope", "function")


def _shares_a_fixture(request: pytest.FixtureRequest) -> bool:
    fixtures = request.node._fixtureinfo.name2fixturedefs
    return any(fixtures[name][-1].scope == "module" for name in fixtures if name != "_module_leaves_no_trace")


@pytest.fixture
def undone_settings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo what a command of the package sets for its process: the log, and that it dumps no core."""
    monkeypatch.setattr(process, "forbid_core_dumps", lambda: None)  # a limit that only root could raise again
    before = structlog.get_config()
    yield
    structlog.configure(**before)


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


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """An empty folder whose path is short: that of a Unix socket in it has at most 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="demo-") as folder:
        yield Path(folder)
