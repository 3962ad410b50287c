"""``python -m uavlinkd``."""

from uavlinkd.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
