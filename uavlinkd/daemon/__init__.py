"""The daemon: it connects the local endpoints, the switch and the protocol core."""
