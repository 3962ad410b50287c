"""The meanings of errors."""

from __future__ import annotations

import errno
import os

from uavlinkd.system.error_meanings import meaning_of


def test_other_errors_of_the_kernel_have_the_systems_text() -> None:
    """A name of the kernel without a line has the kernel's text, and any other word has none."""
    assert "firewall" in meaning_of("EPERM")
    assert meaning_of("ELOOP") == os.strerror(errno.ELOOP)
    assert meaning_of("environ") == meaning_of("outgoing_full") == ""
