"""The daemon's clock. No wall clock: nobody sets it, and it shows no date."""

from __future__ import annotations

import time
from functools import partial

# CLOCK_MONOTONIC stands still while a machine sleeps: what somebody kept back meanwhile would seem to be new, and
# keys would live longer than they may.
monotonic = partial(time.clock_gettime, time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic
"""Seconds since the machine started, those in which it slept included (CLOCK_BOOTTIME, where there is one: Linux)."""
