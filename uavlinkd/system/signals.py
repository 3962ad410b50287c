"""Signals that end or reload a process."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable


def on_signal(name: str, callback: Callable[[], object]) -> None:
    """Call ``callback`` in the running loop when a signal arrives. Windows lacks some signals."""
    loop = asyncio.get_running_loop()
    number: signal.Signals | None = getattr(signal, name, None)
    if number is None:
        return
    try:
        loop.add_signal_handler(number, callback)
    except NotImplementedError:  # Windows
        signal.signal(number, lambda _, __: loop.call_soon_threadsafe(callback))
