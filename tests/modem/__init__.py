"""A member by certificate behind an emulated telemetry modem."""
