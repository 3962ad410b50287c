"""``python -m tests.mavlink.parsers``: see :mod:`tests.mavlink.parsers.command`."""

from __future__ import annotations

import sys

from tests.mavlink.parsers.command import main

if __name__ == "__main__":
    sys.exit(main())
