"""MAVLink without decoding: frames, names, policy and routes. Nothing here does I/O or reads a clock."""
