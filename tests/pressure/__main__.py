"""``python -m tests.pressure``."""

from __future__ import annotations

import sys

from tests.pressure.command import main

sys.exit(main())
