"""The packages that users install: wheel, source distribution and Debian packages."""

import pytest

pytest.register_assert_rewrite("tests.packages.deb_checks", "tests.walkthroughs.raspberry_pi")
