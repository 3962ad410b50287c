"""A simulated autopilot: a MAVLink endpoint to try a link with, without a drone."""
