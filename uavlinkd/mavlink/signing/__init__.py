"""MAVLink's message signing between this daemon and the autopilot beside it (README.md). No clock, no I/O."""
