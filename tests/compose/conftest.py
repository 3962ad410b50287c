"""The image that the containers' tests share."""

from __future__ import annotations

import pytest

from tests.compose import images
from tests.needs import need


@pytest.fixture(scope="session")
def image() -> str:
    """The image of the code as it is, built once."""
    reason = images.why_not()
    need(reason is None, str(reason))
    return images.build()
