"""``python -m tests.network``."""

import sys

from tests.network.command import main

if __name__ == "__main__":  # the processes that it starts import this too
    sys.exit(main())
