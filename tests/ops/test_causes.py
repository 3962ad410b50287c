"""The closed list of causes."""

from __future__ import annotations

import re
from pathlib import Path

from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Severity

README = Path(__file__).parents[2] / "uavlinkd" / "ops" / "README.md"
ATTACKS = {Cause.OWN_KEY_ELSEWHERE, Cause.KEY_ON_TWO_MACHINES, Cause.HIDDEN_FRAME, Cause.IMPERSONATION}


def test_every_cause_is_documented_with_its_severity() -> None:
    """Each cause is in one row of the table, and the row names its severity."""
    section = README.read_text().partition("### Causes")[2].partition("\n## ")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| `") and "`cause`" not in line]
    documented = {name: severity for names, severity, *_ in rows for name in re.findall(r"`(\w+)`", names)}
    assert set(documented) == {cause.value for cause in Cause}
    for cause in Cause:
        assert documented[cause].startswith(cause.severity.name.lower()), cause


def test_attacks_are_security() -> None:
    """And nothing else is: an everyday cause never displaces one."""
    assert {cause for cause in Cause if cause.severity is Severity.SECURITY} == ATTACKS
