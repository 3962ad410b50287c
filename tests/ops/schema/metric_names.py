"""The names of the metrics, each with its type and labels."""

from __future__ import annotations

import re

from tests.web.test_metrics import STATUS
from uavlinkd.web.metrics import exposition


def observed() -> dict[str, str]:
    """Every metric as ``gauge{peer}``."""
    text = exposition(STATUS).decode()
    labels: dict[str, str] = {}
    for name, listed in re.findall(r"(?m)^(uavlinkd_\w+)(?:\{(.*)\})? ", text):
        labels[name] = ",".join(re.findall(r'(\w+)="', listed))
    types = re.findall(r"(?m)^# TYPE (uavlinkd_\w+) (\w+)", text)
    return {name: f"{kind}{{{labels.get(name, '')}}}" for name, kind in types}
