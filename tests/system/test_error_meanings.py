"""The meanings of errors: plain sentences for names that exist."""

from __future__ import annotations

import errno
import os

import pytest

from uavlinkd.system.error_meanings import ERROR_MEANINGS, meaning_of

OWN = {"name_not_resolved", "address_not_here_yet", "folder_in_use", "relay_handle_gone"}
"""Names that the daemon made."""


@pytest.mark.parametrize("name", ERROR_MEANINGS)
def test_meaning_is_a_short_sentence_for_a_name_that_exists(name: str) -> None:
    """Each name is the kernel's or the daemon's own; its meaning is short, and has no full stop at the end."""
    assert name in OWN or name in errno.errorcode.values()
    assert 20 <= len(meaning_of(name)) <= 180
    assert not meaning_of(name).endswith(".")


def test_other_errors_of_the_kernel_have_the_systems_text() -> None:
    """A name of the kernel without a line has the kernel's text, and any other word has none."""
    assert meaning_of("ELOOP") == os.strerror(errno.ELOOP)
    assert meaning_of("environ") == meaning_of("outgoing_full") == ""
