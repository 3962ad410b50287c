"""``python -m uavlinkd.config FILE``: checks a file for a daemon that waits at the other end of the pipe."""

from uavlinkd.config.reader import main

if __name__ == "__main__":
    main()
