"""``python -m tests.modem``."""

import sys

from tests.modem.command import main

if __name__ == "__main__":
    sys.exit(main())
