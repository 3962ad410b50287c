"""Stations: the WireGuard of a daemon, against a client written from the whitepaper, and against wireguard-go."""
