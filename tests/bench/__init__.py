"""The cost of a frame: uavlinkd and others that carry MAVLink between two hosts, measured in one run."""
