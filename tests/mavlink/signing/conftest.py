"""The judges: pymavlink's rules, and MAVLink's C library, which needs a C compiler."""

from __future__ import annotations

import pytest

from tests.mavlink.parsers.receivers import compiler
from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.c_library import CAutopilot


@pytest.fixture(params=[Autopilot, CAutopilot], ids=["pymavlink", "C library"])
def judge(request: pytest.FixtureRequest) -> type[Autopilot]:
    """The class of an autopilot."""
    if request.param is CAutopilot and compiler() is None:
        pytest.skip("needs a C compiler (cc) to build MAVLink's parsers")
    chosen: type[Autopilot] = request.param
    return chosen
