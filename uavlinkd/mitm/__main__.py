"""``python -m uavlinkd.mitm`` is ``uavlink-mitm``."""

import sys

from uavlinkd.mitm.cli import main

if __name__ == "__main__":
    sys.exit(main())
