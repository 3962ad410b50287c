"""The demo: two real daemons on this machine, the man in the middle between them, and what a person sees."""
