"""What other software reads has the declared names and types. For log and metrics, see `tests.test_quality`."""

from __future__ import annotations

from tests.ops.schema import golden, status_names
from tests.test_readmes import ROOT, names_in_table
from uavlinkd.ops import STATUS_SCHEMA


async def test_status_has_the_declared_names() -> None:
    """Of real daemons: one alone, and one with a peer and clients."""
    names = await status_names.observed()
    problems = golden.differences("status", STATUS_SCHEMA, golden.load("status"), names)
    assert not problems, "\n".join(problems)


def test_every_event_is_documented() -> None:
    """In the table of README.md."""
    events = {name for name in golden.load("log")["names"] if "." not in name}
    assert len(events) > 40
    assert events <= names_in_table(ROOT / "uavlinkd/ops/README.md", "Logs")
