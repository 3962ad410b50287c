"""Stations: the official WireGuard app as a ground station, without anything of this project there. See README.md."""
