"""Attacks on the line between two emulated telemetry modems, in virtual time."""
