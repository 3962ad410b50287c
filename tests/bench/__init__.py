"""What a frame costs: uavlinkd beside what else carries MAVLink between two hosts, measured in one run."""
