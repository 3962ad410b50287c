"""What two emulated telemetry modems carry: MAVLink signing on the bare line, and uavlinkd. In virtual time."""
