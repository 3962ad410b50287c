"""``python -m tests.soak``: see :mod:`tests.soak.command`."""

from __future__ import annotations

import sys

from tests.soak.command import main

sys.exit(main())
