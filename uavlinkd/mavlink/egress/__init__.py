"""Which waiting frame is sent next, and when."""
