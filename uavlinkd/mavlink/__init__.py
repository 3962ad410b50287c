"""MAVLink without decoding: frames, names, policy and routes. Nothing here reads a clock or does I/O, except that
`dialect` reads its tables at import."""
