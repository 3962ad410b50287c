"""Which frames may pass: roles, lists and rates, and what a stream to a client may contain."""
