"""Message signing between a daemon and its autopilot."""
