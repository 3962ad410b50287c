"""Serial networks: a line between two daemons, its framing, and how fast it may be filled."""
