"""The package of Debian 12: the tests of ``deb_checks.py``."""

from __future__ import annotations

import pytest

from tests.packages.deb_checks import (
    machine,
    package,
    test_installation_by_hand_is_refused,
    test_package_holds_what_a_vehicle_needs,
    test_two_builds_are_equal,
    test_upgrade_and_downgrade_under_traffic,
)
from tests.walkthroughs.raspberry_pi import test_raspberry_pi_from_a_fresh_image, walk

__all__ = [
    "machine",
    "package",
    "test_installation_by_hand_is_refused",
    "test_package_holds_what_a_vehicle_needs",
    "test_raspberry_pi_from_a_fresh_image",
    "test_two_builds_are_equal",
    "test_upgrade_and_downgrade_under_traffic",
    "walk",
]

RELEASE = 12
pytestmark = pytest.mark.long
