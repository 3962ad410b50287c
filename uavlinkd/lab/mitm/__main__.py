"""``python -m uavlinkd.lab.mitm`` is ``uavlink-mitm``."""

import sys

from uavlinkd.lab.mitm.cli import main

if __name__ == "__main__":
    sys.exit(main())
