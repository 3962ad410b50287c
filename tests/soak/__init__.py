"""A long run of real daemons over the emulated radio: ``python -m tests.soak``."""
