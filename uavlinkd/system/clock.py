"""The daemon's clock. It is monotonic: setting the date of the machine does not change it."""

from __future__ import annotations

import time
from functools import partial

# CLOCK_MONOTONIC stops while the machine sleeps: frames that an attacker delayed meanwhile would seem new, and keys
# would live longer than allowed.
monotonic = partial(time.clock_gettime, time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic
"""Seconds since the machine started, including sleep (CLOCK_BOOTTIME, on Linux)."""
