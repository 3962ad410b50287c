"""``python -m tests.sitl``: see :mod:`tests.sitl.command`."""

from __future__ import annotations

import sys

from tests.sitl.command import main

sys.exit(main())
