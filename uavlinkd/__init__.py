"""Authenticated MAVLink between drones: one daemon per vehicle."""

__version__ = "0.1.0"
