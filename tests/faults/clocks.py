"""Clocks that are wrong, for real daemons."""

from __future__ import annotations

from pathlib import Path

from tests.needs import need


def faked_clock(at: str) -> dict[str, str]:
    """The environment in which a process believes that it is another time; its monotonic clock is genuine."""
    folders = [Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/local/lib")]
    libraries = [library for folder in folders for library in sorted(folder.glob("**/faketime/libfaketime.so.1"))]
    need(bool(libraries), "libfaketime (Debian: faketime)")
    return {"LD_PRELOAD": str(libraries[0]), "FAKETIME": f"@{at}", "FAKETIME_DONT_FAKE_MONOTONIC": "1", "TZ": "UTC"}
