"""``uavlinkd web``: a page of a daemon's links for a browser, in a process of its own. README.md describes it."""
