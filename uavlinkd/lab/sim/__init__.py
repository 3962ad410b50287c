"""A simulated autopilot and the replay of recorded flights: MAVLink endpoints to try a link with, without a drone."""
