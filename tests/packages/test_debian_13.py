"""The package of Debian 13: the tests of ``deb_checks.py``."""

from __future__ import annotations

import pytest

from tests.packages.deb_checks import *  # noqa: F403
from tests.walkthroughs.raspberry_pi import *  # noqa: F403

RELEASE = 13
pytestmark = pytest.mark.long
