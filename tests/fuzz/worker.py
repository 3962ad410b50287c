"""One target in libFuzzer: ``python -m tests.fuzz.worker TARGET PLANT [ARGUMENT ...]``; ``PLANT`` may be empty."""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["uavlinkd"]):
    from tests.fuzz.registry import TARGETS
from tests.fuzz.plants import put

name, plant, *arguments = sys.argv[1:]
put(plant)
atheris.Setup([sys.argv[0], *arguments], TARGETS[name].make())
atheris.Fuzz()  # it ends the process
